"""The mathematics of on-line triangulation: arrays and small frozen dataclasses in and out.

Nothing here knows messages, files, clocks or globals. Time and random generators are arguments.

Conventions (they stand here once; every module follows them)
-------------------------------------------------------------
**Names.** ``R_ab`` turns components in frame *b* into components in frame *a*: ``v_a = R_ab @ v_b``; products read by
adjacency, ``R_lc = R_ln @ R_nb @ R_bc``. ``v_a`` is a vector with components in *a*. Units at borders are in the name
(``time_ns``, ``sigma_m``, ``roll_deg``); inside everything is SI (metre, radian, second).

**Frames.**

===  ===========================================================================================================
l    local: topocentric, right-handed, east-north-up, metres, at the project origin. Object space of adjustments.
e    Earth-fixed (ECEF, WGS 84).
n    navigation: north-east-down at the platform.
b    body: forward-right-down.
c    image: x along flight, y to the left across, z up; the projection centre lies the camera constant ``c`` above
     the focal plane, so that an image point is ``(x, y, -c)``. Image coordinates in millimetres.
===  ===========================================================================================================

With no boresight ``R_bc = diag(1, -1, -1)``.

**Attitude.** Photogrammetric angles: ``R_lc = Rx(omega) Ry(phi) Rz(kappa)``, image to object [K A.20].
Navigation angles: ``R_nb = Rz(heading) Ry(pitch) Rx(roll)``. `geometry.frames` converts between the two, through the
local frame, so that meridian convergence is included. Quaternions are scalar last (``xyzw``).

**Pose covariance.** 6x6, order ``X, Y, Z, omega, phi, kappa``, metres and radians, of the *errors of these six values*
(not of a rotation vector). `geometry.rotation.angles_jacobian` goes between the two.

**Pixels.** Line ``u`` and sample ``v`` are 0-based and integer at the pixel and line centre. Line ``u`` of a strip is
imaged at ``first_line_time + u / line_rate``. Time stamps are integer nanoseconds since the Unix epoch (UTC);
computations use float seconds from a reference stamp that the caller chooses (``time_s``).

**Corrections.** Correction functions are added to the measured orientation: ``X0 = X_measured(t) + dX(t)``,
``omega0 = omega_measured(t) + domega(t)`` and so on [K 4.4-4.7]. Residual = measured minus computed. Where the
attitude is that of an inertial system (recordings, the sliding window; not block folders) ``dkappa`` is a correction of
heading, about the vertical: it turns the measured tilt as well, which counts where it is a tenth of a degree or more
(`geometry.rotation.corrected_angles`; the simulated sensors err in the same way).

**Weights.** Everything is whitened with its own sigma, so that the a-priori sigma0 is 1 (times the a-priori image
sigma where it is given in pixels).

Sources: [K] the dissertation, [P] the piecewise polynomial paper, [D] the rectification thesis; equation numbers as
they give them.
"""
