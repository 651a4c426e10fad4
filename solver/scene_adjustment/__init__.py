"""Bundle adjustment of satellite scenes on the round Earth, whatever model each scene has.

An image is anything of `images.ImageModel`: a rigorous model with correction functions and additional parameters
(`rigorous`), rational polynomials with an affine correction, an affine or a DLT model (`functional`).
`block.SceneBlock` puts them, image points and known ground points together; `solution.adjust` solves it,
`snooping.snoop` leaves out what contradicts the rest.

Object space is Earth-fixed (frame e); every point has axes of its own, east, north and up where it lies, in which its
correction, its sigmas and known coordinates are told. So a block may be as long as the orbit. Image residuals are
measured minus computed, line and sample, in pixels.
"""
