"""Interpolation of orbit and attitude against closed forms, frames of the platform."""

from __future__ import annotations

import numpy as np
import pytest
from satellite_scenes import Truth
from scipy.spatial.transform import Rotation, RotationSpline

from triline.solver.orbit.attitude import (
    AnglesAttitude,
    PolynomialAttitude,
    SplineAttitude,
    TableAttitude,
    unit_quaternions,
)
from triline.solver.orbit.ephemeris import InterpolatedOrbit, PolynomialOrbit
from triline.solver.orbit.line_times import TabulatedLineTimes, UniformLineTimes
from triline.solver.orbit.motion import Motion, R_from_orbital

ORBIT = Truth().orbit


def test_hermite_and_lagrange_meet_a_circular_orbit():
    t = np.arange(-240.0, 300.0, 60.0)
    P, V = ORBIT(t)
    at = np.linspace(-60.0, 120.0, 400)
    true_P, true_V = ORBIT(at)
    # design page S1: 0.6 um and 3.6 um with 60 s between the nodes
    for orbit, metres, speed in ((InterpolatedOrbit(t, P, V), 1e-6, 1e-7), (InterpolatedOrbit(t, P), 1e-5, 1e-6)):
        position, velocity = orbit.at(at)
        assert np.abs(position - true_P).max() < metres
        assert np.abs(velocity - true_V).max() < speed


def test_nodes_are_met_and_may_be_few_and_uneven():
    t = np.array([0.0, 7.0, 19.0, 30.0, 31.0])
    P, V = ORBIT(t)
    for n in range(2, 6):
        for velocity in (None, V[:n]):
            position, slope = InterpolatedOrbit(t[:n], P[:n], velocity).at(t[:n])
            np.testing.assert_allclose(position, P[:n], atol=1e-7)
            if velocity is not None:
                np.testing.assert_allclose(slope, V[:n], atol=1e-7)


def test_a_fitted_polynomial_tells_its_residuals():
    t = np.arange(0.0, 100.0, 10.0)
    P, V = ORBIT(t)
    parabola, quintic = PolynomialOrbit(t, P), PolynomialOrbit(t, P, 5, V)
    assert np.abs(quintic.residual_m).max() < 1e-2 < np.abs(parabola.residual_m).max()
    np.testing.assert_allclose(parabola.at(t)[0] + parabola.residual_m, P, atol=1e-6)
    step = 1e-3
    slope = (quintic.at([50.0 + step])[0] - quintic.at([50.0 - step])[0]) / (2 * step)
    np.testing.assert_allclose(quintic.at([50.0])[1], slope, atol=1e-4)
    with pytest.raises(ValueError, match="order 9 from 4 equations"):
        PolynomialOrbit(t[:4], P[:4], 9)


@pytest.mark.parametrize("kind", [SplineAttitude, TableAttitude])
def test_attitudes_between_their_nodes(kind):
    t = np.arange(0.0, 20.0, 0.5)
    angles = np.stack([0.02 * np.sin(0.2 * t), 0.01 * np.cos(0.3 * t), 1e-3 * t], axis=1)
    attitude = kind(t, -Rotation.from_euler("XYZ", angles).as_quat())
    at = np.linspace(2.0, 17.0, 100)
    true = Rotation.from_euler("XYZ", np.stack([0.02 * np.sin(0.2 * at), 0.01 * np.cos(0.3 * at), 1e-3 * at], axis=1))
    off = (Rotation.from_matrix(attitude.at(at)) * true.inv()).magnitude().max()
    assert off < (3e-7 if kind is SplineAttitude else 1e-4)
    np.testing.assert_allclose(attitude.at(t), Rotation.from_euler("XYZ", angles).as_matrix(), atol=1e-12)


def test_the_fast_spline_is_scipys():
    t = np.array([0.0, 0.3, 1.0, 1.4, 2.0])
    for size in (0.04, 0.4):  # as polynomials, and as it is
        turns = Rotation.from_rotvec(size * np.random.default_rng(3).normal(size=(5, 3)))
        at = np.linspace(0.0, 2.0, 101)
        want = RotationSpline(t, turns)(at).as_matrix()
        np.testing.assert_allclose(SplineAttitude(t, turns.as_quat()).at(at), want, atol=1e-12)


def test_quaternions_of_either_sign_are_one_turn():
    q = Rotation.from_rotvec(np.outer(np.linspace(0, 6.0, 30), [0.0, 0.6, 0.8])).as_quat()
    q[7::3] *= -2.5
    assert (np.einsum("ij,ij->i", unit_quaternions(q)[:-1], unit_quaternions(q)[1:]) > 0.9).all()
    with pytest.raises(ValueError, match="quaternion 3 has no length"):
        unit_quaternions(np.where(np.arange(30)[:, None] == 3, 0.0, q))


def test_polynomials_and_angles():
    attitude = PolynomialAttitude([[0.0, 0.1], [0.0], [0.2], [1.0]], 5.0, 2.0, 0.0, 10.0)
    want = Rotation.from_quat([0.05, 0.0, 0.2, 1.0]).as_matrix()
    np.testing.assert_allclose(attitude.at([6.0])[0], want, atol=1e-15)
    angles = AnglesAttitude([0.0, 1.0], [[0.0, 0.0, 6.2], [0.0, 0.0, -0.08]], "XYZ", margin_s=1.0)
    turn = Rotation.from_matrix(angles.at([0.5, 1.5])).as_rotvec()[:, 2]
    step = 2 * np.pi - 6.28
    np.testing.assert_allclose(turn, [6.2 + 0.5 * step - 2 * np.pi, 6.2 + 1.5 * step - 2 * np.pi], atol=1e-12)


def test_line_times_there_and_back():
    u = np.array([-0.5, 0.0, 13.25, 99.5])
    for times in (UniformLineTimes(3.0, -0.01, 100), TabulatedLineTimes([0, 40, 99], [0.0, 0.4, 1.1], 100),
                  TabulatedLineTimes([0, 99], [5.0, 3.0], 100)):  # fmt: skip
        np.testing.assert_allclose(times.line_of(times.time_of(u)), u, atol=1e-9)


def test_orbital_frame_looks_down_and_ahead():
    P, V = ORBIT(np.array([0.0, 10.0]))
    R = R_from_orbital(P, V)
    np.testing.assert_allclose(R[:, :, 2], -P / np.linalg.norm(P, axis=1, keepdims=True), atol=1e-15)
    assert (np.einsum("ni,ni->n", R[:, :, 0], V) > 0.99 * np.linalg.norm(V, axis=1)).all()
    np.testing.assert_allclose(np.swapaxes(R, -1, -2) @ R, np.broadcast_to(np.eye(3), (2, 3, 3)), atol=1e-14)


class _TurningEarth:
    def R_ie(self, time_s):
        return Rotation.from_rotvec(np.outer(np.atleast_1d(time_s), [0, 0, 7.292115e-5])).as_matrix()


def test_inertial_and_earth_fixed_data_are_one_motion():
    truth, earth = Truth(), _TurningEarth()
    t = np.arange(-120.0, 180.0, 30.0)
    P, V = truth.orbit(t)
    R_ie = earth.R_ie(t)
    P_i = np.einsum("nij,nj->ni", R_ie, P)
    V_i = np.einsum("nij,nj->ni", R_ie, V + np.cross([0, 0, 7.292115e-5], P))
    ta = np.arange(-1.0, 6.0, 0.25)
    fixed = Rotation.from_matrix(truth.R_eb(ta)).as_quat()
    inertial = Rotation.from_matrix(earth.R_ie(ta) @ truth.R_eb(ta)).as_quat()
    at = np.linspace(0.0, 4.0, 20)
    a = Motion(InterpolatedOrbit(t, P, V), SplineAttitude(ta, fixed)).at(at)
    b = Motion(InterpolatedOrbit(t, P_i, V_i), SplineAttitude(ta, inertial), "i", "i", earth).at(at)
    np.testing.assert_allclose(b.position_e, a.position_e, atol=1e-5)
    np.testing.assert_allclose(b.velocity_e, a.velocity_e, atol=1e-6)
    np.testing.assert_allclose(b.R_eb, a.R_eb, atol=1e-9)


def test_what_cannot_be_is_refused():
    t = np.arange(0.0, 100.0, 10.0)
    P, _ = ORBIT(t)
    orbit, attitude = InterpolatedOrbit(t, P), TableAttitude(t + 200.0, np.tile([0, 0, 0, 1.0], (10, 1)))
    for wrong, match in (
        (lambda: InterpolatedOrbit(t[:1], P[:1]), "ephemeris: 1 node, wanted at least 2"),
        (lambda: InterpolatedOrbit(t[::-1], P), "times must increase; node 1 does not"),
        (lambda: InterpolatedOrbit(t, P[:-1]), "do not match 10 times"),
        (lambda: InterpolatedOrbit(t, P * np.nan), "not a number"),
        (lambda: orbit.at([95.0]), r"95.000000 s lies outside the ephemeris \[0.000000, 90.000000\]"),
        (lambda: Motion(orbit, attitude), "have no time in common"),
        (lambda: Motion(orbit, attitude, "i"), "needs the rotation of the Earth"),
        (lambda: Motion(orbit, attitude, "x"), "wanted one of e, i"),
        (lambda: TabulatedLineTimes([0, 5, 9], [0.0, 2.0, 1.0], 10), "the time of line 9 goes back"),
        (lambda: UniformLineTimes(0.0, 0.0, 10), "a period that is not 0"),
    ):
        with pytest.raises(ValueError, match=match):
            wrong()
