"""From pixels to the ground and back: rigorous pushbroom sensors, rational polynomials, and their fit.

Every model has the same pair: ``direct(line, sample, height_m)`` gives latitude, longitude (radians) and height above
the ellipsoid, ``inverse(lat, lon, height_m)`` gives line and sample. Line and sample are 0-based and integer at the
centre of a pixel; what has no answer is NaN.
"""
