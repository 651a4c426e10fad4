"""The network in the window: strips, points with their looks, batches of points, and the unknowns they share."""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections import Counter
from collections.abc import Iterator, KeysView
from operator import itemgetter

import numpy as np

from ...adjustment.pose_noise import PoseNoise
from ...adjustment.surface_control import SurfaceControl
from ...arrays import Array, IntArray
from ...camera.line_camera import LineCamera
from ...camera.self_calibration import SelfCalibration
from ...geometry.measured_trajectory import MeasuredTrajectory
from ...models.platform import NO_PLATFORM_ERRORS, PlatformErrors
from .batch import Batch, Counts
from .calibration import LiveCalibration
from .platform import LivePlatform
from .points import Intake
from .sigma_factors import SigmaFactors
from .strip import WindowStrip
from .surface import LiveSurface
from .tails import Tails
from .unknowns import Information, WindowState
from .vibrations import Vibrations


class Batches:
    """The batches whose information is in the live part of the state, in the order in which they came.

    All that changes what the state holds of a batch goes through here, and what is asked in every update is kept: there
    are up to thousands of batches.

    Attributes
    ----------
    gone : how many have been taken apart or become final
    """

    def __init__(self, state: WindowState) -> None:
        self._state = state
        self._by_id: dict[int, Batch] = {}
        self._counts, self._points = Counts(0, 0, 0, 0, 0, 0), Counter[int]()
        self._by_age: list[tuple[float, int, Batch]] = []  # time of the oldest ray, and which came first
        self._place: dict[int, int] = {}  # in the order in which they came
        self._came = 0
        self._with_control: dict[int, Batch] = {}
        self._provisional: dict[int, Batch] = {}
        self.gone = 0

    def __iter__(self) -> Iterator[Batch]:
        return iter(self._by_id.values())

    def __len__(self) -> int:
        return len(self._by_id)

    def __contains__(self, batch: Batch) -> bool:
        return id(batch) in self._by_id

    def missing(self, ids: KeysView[int]) -> set[int]:
        """Which of the identities of batches that somebody still holds are not those of any of these."""
        return ids - self._by_id.keys()

    @property
    def counts(self) -> Counts:
        """What all of them count for."""
        return self._counts

    def points_in(self, strip: int) -> int:
        """Points of batches with rays of a strip."""
        return self._points[strip]

    def with_control(self) -> list[Batch]:
        """Those with control that counts."""
        return list(self._with_control.values())

    def provisional(self) -> list[Batch]:
        """Those that lean on filtered poses, in the order in which they came."""
        self._provisional = {key: batch for key, batch in self._provisional.items() if batch.provisional}
        return list(self._provisional.values())

    @property
    def oldest_s(self) -> float:
        """Time of the oldest ray; infinite without any."""
        return self._by_age[0][0] if self._by_age else float("inf")

    def older_than(self, time_s: float) -> list[Batch]:
        """Those with a ray that is not newer than this, in the order in which they came."""
        old = self._by_age[: bisect_right(self._by_age, time_s, key=itemgetter(0))]
        return [batch for *_, batch in sorted(old, key=itemgetter(1))]

    def enter(self, batch: Batch) -> None:
        """A batch comes."""
        self._by_id[id(batch)] = batch
        self._came += 1
        self._place[id(batch)] = self._came
        insort(self._by_age, (batch.oldest_s, self._came, batch))
        self._points.update(dict.fromkeys(batch.strips, batch.n_points))
        self._count(batch, batch.counts, 1)
        if batch.provisional:
            self._provisional[id(batch)] = batch
        self._state.add(batch.columns, batch.information)

    def remove(self, batch: Batch) -> None:
        """A batch is taken apart."""
        self._forget(batch)
        self._state.add(batch.columns, batch.information, -1)

    def leave(self, batch: Batch) -> None:
        """A batch becomes final: what it knows stays."""
        self._forget(batch)
        self._state.fix(batch.columns, batch.information)

    def _forget(self, batch: Batch) -> None:
        del self._by_id[id(batch)]
        del self._by_age[bisect_left(self._by_age, (batch.oldest_s, self._place.pop(id(batch))))]
        self.gone += 1
        self._points.subtract(dict.fromkeys(batch.strips, batch.n_points))
        self._count(batch, batch.counts, -1)
        self._with_control.pop(id(batch), None)
        self._provisional.pop(id(batch), None)

    def _count(self, batch: Batch, counts: Counts, sign: int) -> None:
        self._counts = Counts(*(a + sign * b for a, b in zip(self._counts, counts, strict=True)))
        if batch.counts.control:
            self._with_control[id(batch)] = batch
        else:
            self._with_control.pop(id(batch), None)

    def linearise(self, batch: Batch, theta: Array, reweigh: bool) -> None:
        """Linearise a batch again, see `Batch.linearise`."""
        before, counted = batch.information, batch.counts
        batch.linearise(theta, reweigh)
        self.exchange(batch, before, counted)

    def reweigh(self, batch: Batch, weight: Array) -> None:
        """Give the rays of a batch other weights (n,)."""
        batch.weight = weight
        self.eliminate(batch)

    def eliminate(self, batch: Batch) -> None:
        """Let count what was changed in a batch: weights of its rays and of its control, its ties."""
        before, counted = batch.information, batch.counts
        batch.eliminate()
        self.exchange(batch, before, counted)

    def exchange(self, batch: Batch, before: Information, counted: Counts) -> None:
        """Let count what a batch knows by now, in place of the information and the counts that it had."""
        self._count(batch, counted, -1)
        self._count(batch, batch.counts, 1)
        self._state.exchange(batch.columns, before, batch.information)


class LiveNetwork:
    """What the window holds; every phase of an update works on it.

    Parameters
    ----------
    camera : line camera
    self_calibration : additional parameters that are estimated all along
    platform : constant errors of the platform that are
    surface : on which tie points lie; None for none

    Attributes
    ----------
    trajectory : the measured trajectory; its covariance is that of the white noise alone
    state : the unknowns
    strips : by name, in the order in which they began
    intake : points that are not final, with their looks, and known coordinates
    batches : points with their equations
    pose_noise : what the corrections leave of the noise of poses
    vibrations : what has been estimated of vibrations of the attitude
    sigmas : what a-priori sigmas are multiplied by
    tails : how many looks fail narrowly
    platform : constant errors of the platform
    calibration : additional parameters of the camera
    surface : on which tie points lie
    """

    def __init__(
        self,
        camera: LineCamera,
        self_calibration: SelfCalibration | None = None,
        platform: PlatformErrors = NO_PLATFORM_ERRORS,
        surface: SurfaceControl | None = None,
    ) -> None:
        self.camera, self.self_calibration = camera, self_calibration
        self.trajectory = MeasuredTrajectory()
        self.state = WindowState()
        self.strips: dict[str, WindowStrip] = {}
        self.intake = Intake(camera, self.strips, self.trajectory)
        self.batches = Batches(self.state)
        self.pose_noise = PoseNoise(self.trajectory)
        self.vibrations = Vibrations()
        self.sigmas = SigmaFactors()
        self.tails = Tails()
        self.platform = LivePlatform(platform, self.trajectory, self.state)
        self.calibration = LiveCalibration(self_calibration, self.state)
        self.surface = LiveSurface(surface, self.state)

    @property
    def camera_columns(self) -> IntArray:
        """(m,) numbers of the additional parameters."""
        return self.calibration.numbers

    @property
    def shared_columns(self) -> IntArray:
        """Numbers of the unknowns that all strips share: of the platform, of the camera, of the surface."""
        return np.concatenate([self.platform.numbers, self.camera_columns, self.surface.numbers])

    @property
    def shared_sigma(self) -> Array:
        """What is known of these beforehand, as stated or as restated."""
        return np.concatenate([self.platform.sigma, self.calibration.sigma, self.surface.sigma])

    @property
    def like_an_offset(self) -> IntArray:
        """Numbers of the unknowns that explain what an offset of the trajectory would explain as well: the focal length
        where no free parameters are beside it, and the lever arm."""
        parameters, one = self.self_calibration, self.camera_columns[:0]
        if parameters is not None and (parameters.as_calibrated or parameters.n_unknowns == 1):
            one = self.camera_columns[[name.startswith("dc") for name in parameters.unknown_names]]
        return np.concatenate([self.platform.numbers[~self.platform.errors.questioned], one])

    @property
    def noise_version(self) -> int:
        """How often what is known of the noise of poses and images has changed."""
        return self.pose_noise.version + self.sigmas.version

    @property
    def flown(self) -> list[WindowStrip]:
        """Strips of which something is left in the window, oldest first."""
        return [s for s in self.strips.values() if not s.is_gone(self.state)]

    def index(self, strip: WindowStrip) -> int:
        """Place of a strip, as rays name it."""
        return list(self.strips).index(strip.id)

    def of_strip(self, strip: WindowStrip) -> list[Batch]:
        """Batches with rays of a strip."""
        index = self.index(strip)
        return [b for b in self.batches if index in b.strips]
