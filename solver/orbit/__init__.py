"""Where a satellite is and how it is turned at any time: time scales, Earth orientation, orbit, attitude, line times.

Frames beside those of the solver (`triline.solver`):

===  ===========================================================================================================
i    inertial: the geocentric celestial frame (GCRS); its axes are those of EME2000 but for the frame bias.
e    Earth-fixed (ITRF; WGS 84 agrees with it to some centimetres), or fixed to another planet.
o    orbital: z to the centre of the Earth, y against the orbital angular momentum, x completes (about along the
     velocity) [D 4.25-4.28].
b    body of the satellite or camera, as the file that the attitude comes from defines it.
===  ===========================================================================================================

Times are float seconds of TAI from a reference that the caller chooses; references are integer nanoseconds of TAI since
1970-01-01 00:00:00 TAI (`time_scales`). So a second is a second, also where UTC has a leap second.
"""
