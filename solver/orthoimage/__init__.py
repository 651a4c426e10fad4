"""Direct rectification of image lines: rays of pixels to the ground, and the ground's cells back to pixels.

`surface` is what rays meet (plane, ellipsoid, heights), `ground_grid` the cells of a map projection, `strip` turns the
lines of a strip into patches of the orthoimage, `mosaic` puts patches together, `orientation` tells where each line was
taken from.
"""
