"""What is judged besides data snooping: integrity, sources that drift, determinability of parameters, and the light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...arrays import Array
from ...models.base import OFFSET, POSITION_WANDER, SHIFT
from ..datum.control import ControlTests
from ..datum.surface import SurfaceTests
from ..results import RefinedOrientation, WindowOptions
from ..state.network import LiveNetwork
from ..state.strip import WindowStrip
from .camera_check import CameraCheck
from .determinability import Determinability
from .exposure import Exposure, Integrity
from .ground import GroundBelow
from .light import Fit, LightDisplay, QualityFindings


class QualityControl:
    """Judges the window after its updates; what costs much is spread over updates.

    Parameters
    ----------
    control : judges control, and knows of tie points that drift
    surface : judges the surface that tie points lie on

    Attributes
    ----------
    integrity : what could be wrong unseen
    last : what the last look found, without its events
    """

    def __init__(
        self, network: LiveNetwork, control: ControlTests, options: WindowOptions, surface: SurfaceTests
    ) -> None:
        self._surface = surface
        self._network, self._control, self._sources = network, control, control.sources
        self._limit_m, self._below, self._display = options.alert_limit_m, GroundBelow(network.camera), LightDisplay()
        self._parameters: Determinability | None = None
        estimated = network.self_calibration
        if estimated is not None and options.determine and not estimated.as_calibrated:
            self._parameters = Determinability(estimated, network.camera_columns, network.camera)
        self._camera = CameraCheck(network)
        self.integrity = Integrity(options.critical, network)
        self.last: QualityFindings | None = None

    def protected(self, strip: WindowStrip, orientation: RefinedOrientation, final: bool = False) -> RefinedOrientation:
        """Orientation with protection levels, as that at the middle of its times is exposed; whether it is final."""
        exposure = self.exposure_at(strip, float(orientation.time_s[len(orientation.time_s) // 2]))
        if final:
            levels, ground = np.empty(0), self._below.ground
            if exposure is not None and ground is not None:
                levels = exposure.factor[6:] * ground.sigma_m(orientation.covariance)
            self._display.records[strip.id].became_final(len(orientation.time_s), levels, self._alert_limit_m)
        return orientation if exposure is None else exposure.protected(orientation)

    def exposure_at(self, strip: WindowStrip, time_s: float, renew: bool = False) -> Exposure | None:
        """Exposure of the orientation at a time of a strip, and on the ground; None if its unknowns are not there."""
        numbers, A = strip.design([time_s]).functions()
        if not len(numbers) or (self._network.state.places(numbers) < 0).any():
            return None
        functions, ground = A[0], self._below.ground
        if ground is not None:
            functions = np.concatenate([A[0], ground.functions @ A[0]])
        return self.integrity.at(numbers, functions, self._network.state, renew)

    def watch_sources(self, now_s: float, look: bool, test: bool, wander: float = 0.0) -> bool:
        """Tie points that drift: take in what has settled where there is a look, test where it is time; whether others
        drift than before.

        Parameters
        ----------
        wander : what speaks for a wander of the trajectory that is larger than stated, see `SigmaCheck.gain_of_wanders`
        """
        before = self._sources.biased
        if look:
            if self._sources.begin():
                self._control.strip_began()
            self._sources.take_in(now_s)
        # while new looks disagree by far more than sigmas say, these are asked first: no source is named as well
        if test and (before or self._network.sigmas.disagreement == 1.0):
            # where control and GNSS are told to differ, that is why all tie points contradict one of them
            self._sources.test(now_s, of_all=not self._control.differs_from_gnss, instead=wander)
        return self._sources.biased != before

    def look(self, now_s: float, length_s: float, fit: Fit, noise: Array) -> QualityFindings:
        """Findings of an update.

        Parameters
        ----------
        fit : how well observations and a-priori sigmas agree
        noise : (6, 6) covariance of the noise that is on the newest orientation
        """
        network, batches, flown = self._network, list(self._network.batches), self._network.flown
        strip = flown[-1] if flown else None
        ground = self._below.look(batches)
        time_s, exposure = -np.inf, None
        sigma = protection = np.zeros(6)
        if strip is not None and batches:
            time_s = min(now_s, strip.end_s)
            exposure = self.exposure_at(strip, time_s, renew=True)
            if exposure is not None:
                sigma = self._sigma(strip, time_s, exposure, noise)
                protection = exposure.factor * sigma
        events: list[str] = []
        if self._parameters is not None:
            gsd_m = 1.0 if ground is None else ground.gsd_m
            events = self._parameters.step(now_s, network.state, batches, fit.sigma0_total, fit.redundancy_total, gsd_m)
        events += self._camera.look(now_s)
        left = [b.points_left for b in batches]
        rays = np.concatenate([np.empty(0, np.int64), *left])
        tied = int((rays >= 2).sum())
        known = np.concatenate([np.empty((0, 3)), *(b.control.weight for b in batches)]) > 0
        a, b, c = network.sigmas.apriori[[OFFSET, SHIFT, POSITION_WANDER]].tolist()
        failing, narrowly = network.tails.shares(batches)
        found = QualityFindings(
            strip="" if strip is None else strip.id,
            length_s=length_s,
            since_s=0.0 if strip is None else now_s - strip.model.extent.start_s,
            fit=fit,
            points=len(rays),
            refused=int((rays == 0).sum()),
            tied=tied,
            free=tied - self._tied_control(),
            late=0.0 if strip is None else network.intake.late_share(strip.id),
            control=known[rays > 0].sum(axis=0),
            control_refused=sum(b.control_refused for b in batches),
            control_doubt="; ".join(filter(None, (self._control.doubt, self._surface.doubt))),
            held_by="the elevation model" if self._surface.holds else "earlier control",
            control_failed=self._control.fails(self._alert_limit_m),
            camera=self._camera.doubt,
            calibration=network.calibration.factor,
            apriori_m=np.ones(3) if strip is None else strip.slow.position_sigma,
            sources=self._sources.biased,
            time_s=time_s,
            exposure=exposure,
            sigma=sigma[:6],
            protection=protection[:6],
            ground_sigma_m=sigma[6:],
            ground_protection_m=protection[6:],
            alert_limit_m=self._alert_limit_m,
            standing=() if self._parameters is None else self._parameters.standing,
            failing=failing,
            narrowly=narrowly,
            disagreement=float(network.sigmas.disagreement),
            trajectory=(a, b, c),
            attitude_at_most_s=network.sigmas.attitude_at_most_s,
        )
        light, reason = self._display.look(now_s, found)
        self.last = replace(found, light=light, reason=reason)
        return replace(self.last, events=tuple(events))

    def _tied_control(self) -> int:
        """How many points of the window are control, by name, and have two looks left."""
        intake, count = self._network.intake, 0
        for name in intake.control:
            batch = intake.points[name].batch if name in intake.points else None
            if batch is not None and batch in self._network.batches:
                count += int(batch.points_left[batch.names.index(name)]) >= 2
        return count

    @property
    def _alert_limit_m(self) -> float:
        ground = self._below.ground
        return self._limit_m or (np.inf if ground is None else ground.limit_m)

    def _sigma(self, strip: WindowStrip, time_s: float, exposure: Exposure, noise: Array) -> Array:
        """Sigmas of the orientation and, where it is known, on the ground (6 + g,).

        To those from the unknowns come tie points that drift and, on the ground alone, the noise (6, 6) of the measured
        orientation.
        """
        drifts, C = self._sources.compensation(), np.zeros((6, 6))
        if drifts is not None:
            numbers, A = strip.design([time_s]).functions()
            C = drifts.change(A[0], self._network.state.places(numbers))[1]
        ground = self._below.ground
        on_ground = np.empty(0) if ground is None else ground.sigma_m(noise + C) ** 2
        return np.sqrt(exposure.sigma**2 + np.concatenate([np.diagonal(C), on_ground]))
