"""The simulated errors are those the project message states: a dense adjustment that takes its word is consistent.

The adjustment is written down here from the error model alone - offset, shift and drift as weighted constants, the
wander as value and slope at knots with its exact transition as prior - and shares nothing with the estimators.
"""

import numpy as np
import pytest

from triline.solver.camera.collinearity import image_motion, project
from triline.solver.models.gauss_markov import second_order_gauss_markov
from triline.solver.simulation.flight import FlightPlan
from triline.solver.simulation.scenario import ObservationPlan, simulate

KNOT_S = 2.0
OBSERVED = ObservationPlan(tie_points_per_s=2.5, control=4, check=20)


class DenseAdjustment:
    """Everything at once, with dense matrices; from the true point coordinates, so that two steps are enough."""

    def __init__(self, simulation):
        self.s = simulation
        strip, looks = simulation.flight.strips[0], simulation.images.looks
        self.start, self.end = simulation.flight.strip_times_s[0]
        self.knots = int(np.ceil((self.end - self.start) / KNOT_S)) + 1
        self.n_pose = 9 + 12 * self.knots
        self.time = strip.time_of(simulation.images.line)
        truth = simulation.flight.truth.at(self.time)
        slow = simulation.slow.at(self.time)
        self.position, self.angles = truth.position_l + slow[:, :3], truth.angles + slow[:, 3:]
        self.focal = simulation.flight.camera.focal_length_mm[looks.ccd]
        self.xy, self.pitch = simulation.flight.camera.image_coordinates(looks.ccd, simulation.images.sample)
        self.velocity, self.rate, self.period = truth.velocity_l, truth.angle_rate, 1.0 / strip.line_rate_hz
        self.points = simulation.points.xyz_l.copy()
        self.theta = np.zeros(self.n_pose)

    def design(self, time):
        """Corrections at times (n,) by the pose unknowns: (n, 6, n_pose)."""
        k = np.clip(((time - self.start) / KNOT_S).astype(int), 0, self.knots - 2)
        u = (time - self.start) / KNOT_S - k
        hermite = (2 * u**3 - 3 * u**2 + 1, KNOT_S * (u**3 - 2 * u**2 + u), 3 * u**2 - 2 * u**3, KNOT_S * (u**3 - u**2))
        D = np.zeros((len(time), 6, self.n_pose))
        rows = np.arange(len(time))
        for c in range(6):
            D[rows, c, c] = 1.0
            if c >= 3:
                D[rows, c, 3 + c] = (time - self.start) / (self.end - self.start)
            for value, (knot, slope) in zip(hermite, ((k, 0), (k, 1), (k + 1, 0), (k + 1, 1)), strict=True):
                D[rows, c, 9 + 12 * knot + 2 * c + slope] += value
        return D

    def prior(self):
        """Normal matrix of what is known beforehand."""
        e = self.s.errors
        M = np.zeros((self.n_pose, self.n_pose))
        constant = np.concatenate([e.offset_sigma_m, np.radians(e.shift_sigma_deg), np.radians(e.drift_sigma_deg)])
        M[range(9), range(9)] = constant**-2
        wander = np.concatenate([e.wander_sigma_m, np.radians(e.wander_sigma_deg)])
        for c, sigma in enumerate(wander):
            F, Q, P0 = second_order_gauss_markov(sigma, e.wander_time_s, KNOT_S)
            first = 9 + 2 * c + np.arange(2)
            M[np.ix_(first, first)] += np.linalg.inv(P0)
            J = np.hstack([-F, np.eye(2)])
            step = J.T @ np.linalg.inv(Q) @ J
            for k in range(self.knots - 1):
                both = np.concatenate([first + 12 * k, first + 12 * (k + 1)])
                M[np.ix_(both, both)] += step
        return M

    def solve(self):
        """Two Gauss-Newton steps; covariance of all unknowns and the weighted sum of squares."""
        looks, n, m = self.s.images.looks, len(self.time), len(self.points)
        rows, D, prior = np.arange(n), self.design(self.time), self.prior()
        control = np.flatnonzero(self.s.points.role == "control")
        weight = np.array(self.s.observation_plan.control_sigma_m) ** -2
        for _ in range(2):
            corrected = D @ self.theta
            p = project(
                self.position + corrected[:, :3], self.angles + corrected[:, 3:], self.points[looks.point], self.focal
            )
            v = self.xy - p.xy_mm
            motion = image_motion(p.d_orientation, self.velocity, self.rate) * self.period
            outer = motion[:, :, None] * motion[:, None, :] + self.pitch[:, :, None] * self.pitch[:, None, :]
            W = np.linalg.inv(self.s.observation_plan.image_sigma_px**2 * outer)
            A = np.zeros((n, 2, self.n_pose + 3 * m))
            A[:, :, : self.n_pose] = p.d_orientation @ D
            for j in range(3):
                A[rows, :, self.n_pose + 3 * looks.point + j] = p.d_point[:, :, j]
            WA = (W @ A).reshape(2 * n, -1)
            N, g = A.reshape(2 * n, -1).T @ WA, WA.T @ v.ravel()
            N[: self.n_pose, : self.n_pose] += prior
            g[: self.n_pose] -= prior @ self.theta
            for i in control:
                at = self.n_pose + 3 * i + np.arange(3)
                N[at, at] += weight
                g[at] += weight * (self.s.surveyed_l[i] - self.points[i])
            step = np.linalg.solve(N, g)
            self.theta += step[: self.n_pose]
            self.points += step[self.n_pose :].reshape(-1, 3)
        squares = np.einsum("ni,nij,nj->", v, W, v) + self.theta @ prior @ self.theta
        squares += np.sum(weight * (self.s.surveyed_l[control] - self.points[control]) ** 2)
        return np.linalg.inv(N), squares, 2 * n + 3 * len(control) - 3 * m


@pytest.mark.parametrize("stabilised", [True, False])
def test_adjustment_with_the_stated_error_model_is_consistent(stabilised):
    """Normalised errors squared of check points and of orientation, and sigma0, over 10 flights: two-sided."""
    point, pose, squares, redundancy, before, after = [], [], 0.0, 0, [], []
    for seed in range(10):
        s = simulate(FlightPlan(strip_s=36.0, stabilised=stabilised), seed, observation_plan=OBSERVED)
        adjustment = DenseAdjustment(s)
        covariance, sum_of_squares, free = adjustment.solve()
        squares, redundancy = squares + sum_of_squares, redundancy + free
        check = np.flatnonzero(s.points.role == "check")
        at = adjustment.n_pose + (3 * check[:, None] + np.arange(3)).ravel()
        error = (adjustment.points[check] - s.points.xyz_l[check]).ravel()
        point.append(error @ np.linalg.solve(covariance[np.ix_(at, at)], error) / len(error))
        time = np.array([0.5 * (adjustment.start + adjustment.end)])
        D = adjustment.design(time)[0]
        left = s.slow.at(time)[0] + D @ adjustment.theta
        P = D @ covariance[: adjustment.n_pose, : adjustment.n_pose] @ D.T
        pose.append(left @ np.linalg.solve(P, left) / 6)
        before.append(s.slow.at(time)[0])
        after.append(left)
    assert np.mean(point) == pytest.approx(1.0, abs=4 * np.sqrt(2 / (10 * 60)))
    assert np.mean(pose) == pytest.approx(1.0, abs=4 * np.sqrt(2 / (10 * 6)))
    assert np.sqrt(squares / redundancy) == pytest.approx(1.0, abs=4 / np.sqrt(2 * redundancy))
    # and the network does determine the orientation
    assert (np.std(before, axis=0) > 3.0 * np.std(after, axis=0)).all()
