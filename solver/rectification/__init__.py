"""Images of any sensor become orthoimages: the way from the cells of a map to the image, and back.

*Indirect* (ground to pixel): the location model is asked at a few nodes of a tile and at a few heights, and a
polynomial that was checked against it gives every cell its pixel, at the height of the terrain there (`cell_to_pixel`).
*Direct* (pixel to ground, as the source does [D 4]): the ray of every pixel is led to the terrain, and the mesh of the
ground points gives the cells between them their pixel (`pixel_to_cell`). Both end in the same resampling.

Tiles are independent of each other. Cells are counted in columns and rows, whole numbers at their centres.
"""
