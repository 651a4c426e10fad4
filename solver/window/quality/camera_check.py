"""Whether the camera is as its calibration says, where its distortion is not free.

A distortion that nobody stated bends the trajectory, makes control contradict itself and the GNSS, and raises every
sigma that is questioned. What tells it from all of these: looks at one place of a CCD line are off by the same,
whenever they were taken. The additional parameters of a set are tested as unknowns would be, without estimating them,
by their scores ``s`` at the solution, whose cofactors ``V`` are what is left when all unknowns of the window have been
eliminated: ``s^T V^-1 s`` is chi-square if the camera is as calibrated. That part of it is taken away which a shift of
each CCD line, or another camera constant, explains as well: tie points that are off on one line look like that, and
others watch for these (`drift_monitor`, and the camera constant as an unknown).

Source: score test of parameters that are not estimated: C. R. Rao, Large sample tests of statistical hypotheses
concerning several parameters with applications to problems of estimation, 1948.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ...adjustment.pose_noise import in_step
from ...arrays import Array
from ...camera.displacement import Displacement, displacements, most_certain
from ...camera.self_calibration import lens, tls
from ...quantiles import chi2
from ..screening.look_noise import NoiseOfLooks
from ..state.batch import Batch
from ..state.network import LiveNetwork
from ..state.unknowns import Border

#: Kinds of parameters that others watch.
WATCHED = ("dc", "xp", "yp", "dx", "dy")
#: Time between tests, s, rays that are looked at, and those wanted to say anything. Tuned, for speed.
TEST_EVERY_S, MOST_RAYS, LEAST_RAYS = 5.0, 1500, 60
#: Probability that a camera as calibrated fails a test, and that from which it passes; so many tests have to agree
#: (statistical levels).
FALSE_ALARM, PASSES, AGREEING = 1e-6, 1e-3, 2
#: Eigenvalues of scaled cofactors below this are those of parameters that all else explains as well. Tuned.
UNSEEN = 1e-6
#: A displacement of so many pixels, where it is known best, spoils the orientation by more than its sigmas say. Tuned.
SPOILS_PX = 1.0


@dataclass(frozen=True)
class CameraDoubt:
    """A camera that is not as calibrated.

    Attributes
    ----------
    test, limit : value of the test, and what it is by chance at most
    worst : displacement of looks where it is most certain
    remedy : the set of additional parameters that would be estimated
    """

    test: float
    limit: float
    worst: Displacement
    remedy: str

    @property
    def spoils(self) -> bool:
        """Whether sigmas of the orientation can no longer be relied on."""
        return self.worst.off_px > SPOILS_PX

    def __str__(self) -> str:
        return (
            f"the camera is not as calibrated: looks are off by where they fall on the CCD lines, by {self.worst}; "
            f'wanted is a calibration, or self_calibration = "{self.remedy}"'
        )


class CameraCheck:
    """The test, again and again while a flight lasts.

    Attributes
    ----------
    doubt : what was found, None while the camera may be as calibrated
    """

    def __init__(self, network: LiveNetwork) -> None:
        self._network, self._looks, camera = network, NoiseOfLooks(network), network.camera
        self._set, self._remedy = (tls(camera), "tls12") if len(camera.lenses) == 1 else (lens(camera), "lens")
        kinds = [name.split("_")[0] for name in self._set.unknown_names]
        self._watched = np.array([kind in WATCHED for kind in kinds])
        estimated = network.self_calibration
        names = () if estimated is None or estimated.as_calibrated else estimated.unknown_names
        # what is free cannot contradict anything; what a calibration leaves open can
        self._next_s = -np.inf if all(name.split("_")[0] in WATCHED for name in names) else np.inf
        self._failed = self._passed = 0
        self.doubt: CameraDoubt | None = None

    def look(self, now_s: float) -> list[str]:
        """Test when it is time; the state is solved. Returns lines for the operator."""
        if now_s < self._next_s:
            return []
        self._next_s = now_s + TEST_EVERY_S
        found = self._test()
        if found is None:
            return []
        doubt, passes = found
        self._failed = self._failed + 1 if doubt is not None else 0
        self._passed = self._passed + 1 if passes else 0
        if doubt is not None and (self._failed >= AGREEING or self.doubt is not None):
            before, self.doubt = self.doubt, doubt
            return [] if before is not None else [f"camera: {doubt}"]
        if self.doubt is not None and self._passed >= AGREEING:
            self.doubt = None
            return ["camera: looks do not contradict its calibration any more"]
        return []

    def _test(self) -> tuple[CameraDoubt | None, bool] | None:
        """What is wrong, and whether nothing is; None where there is too little to say."""
        score, V, rays = self._scores()
        if rays < LEAST_RAYS:
            return None
        # looks that disagree as a whole are a matter of sigmas, and a vibration may be in step with the views
        variance = max(float(self._network.sigmas.disagreement), 1.0) ** 2 * in_step(self._looks.vibrating)
        all_of_it, m = _chi_square(score, V)
        by_others, k = _chi_square(score[self._watched], V[np.ix_(self._watched, self._watched)])
        if m <= k:
            return None
        test, limit = (all_of_it - by_others) / variance, float(chi2.isf(FALSE_ALARM, m - k))
        if test <= limit:
            return None, test < float(chi2.isf(PASSES, m - k))
        return CameraDoubt(test, limit, self._worst(score / variance, V / variance), self._remedy), False

    def _scores(self) -> tuple[Array, Array, int]:
        """Scores (m,) of the parameters at the solution and their cofactors (m, m), from the newest rays; their
        number."""
        state, m, rays = self._network.state, self._set.n_unknowns, 0
        border = Border.of(m, state.numbers)
        for batch, use in self._newest():
            effect = np.where(use[:, None, None], self._effect(batch), 0.0)
            coupling = np.add.reduceat(np.swapaxes(batch.through_points, 1, 2) @ effect, batch.first_ray[:-1], axis=0)
            border.join(np.arange(m), batch.border(effect, coupling))
            rays += int(use.sum())
        if rays < LEAST_RAYS:
            return border.r, border.H, rays
        return *border.scores(*state.normal()), rays

    def _newest(self) -> Iterator[tuple[Batch, Array]]:
        """Batches from the newest one on, and which of their rays (n,) have weight at points that are known."""
        rays = 0
        for batch in reversed(list(self._network.batches)):
            use = (batch.weight > 0) & (batch.normals.rank[batch.rays.point] == 3)
            rays += int(use.sum())
            yield batch, use
            if rays > MOST_RAYS:
                return

    def _effect(self, batch: Batch) -> Array:
        """Effect (n, 2, m) of the parameters on the weighted equations of the rays of a batch."""
        rays, g = batch.rays, batch.whitening.g
        raw = displacements(self._set, rays.ccd, rays.sample, rays.xy_mm, rays.focal_length_mm)
        effect = np.empty((len(rays), 2, raw.shape[2]))
        effect[:, 0] = g[0][:, None] * raw[0]
        effect[:, 1] = g[1][:, None] * raw[0] + g[2][:, None] * raw[1]
        return effect

    def _worst(self, score: Array, V: Array) -> Displacement:
        """The displacement that is most certain."""
        Q = np.linalg.inv(V + np.diag(self._set.apriori_sigma**-2.0))
        return most_certain(self._network.camera, self._set, Q @ score, Q)


def _chi_square(score: Array, V: Array) -> tuple[float, int]:
    """``s^T V^-1 s`` of scores (m,) with cofactors (m, m), over what the observations see; how many that are."""
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(V), 1e-300))
    values, vectors = np.linalg.eigh(V * np.outer(scale, scale))
    seen = values > UNSEEN
    z = (vectors.T @ (score * scale))[seen]
    return float((z**2 / values[seen]).sum()), int(seen.sum())
