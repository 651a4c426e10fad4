"""A flight with a camera that is not as calibrated: its additional parameters are drawn from what is said of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..camera.self_calibration import SelfCalibration
from .error_models import ErrorModel
from .flight import FlightPlan
from .network import disturb_camera
from .scenario import ObservationPlan, Simulation, simulate
from .streams import stream


def simulate_with_camera_errors(
    plan: FlightPlan, seed: int, stated: SelfCalibration, errors: ErrorModel, observation_plan: ObservationPlan
) -> Simulation:
    """Fly a plan with a true camera that differs from the plan's, which estimators get.

    Parameters
    ----------
    stated : parameters and the sigmas that their true values are drawn with
    """
    drawn = drawn_parameters(seed, stated)
    true = disturb_camera(plan.camera, stated, dict(zip(stated.unknown_names, drawn.tolist(), strict=True)))
    flown = simulate(replace(plan, camera=true), seed, errors, observation_plan)
    return replace(flown, flight=replace(flown.flight, camera=plan.camera))


def drawn_parameters(seed: int, stated: SelfCalibration) -> NDArray[np.floating]:
    """True values (n_unknowns,) of the parameters of the flight of a seed."""
    return stream(seed, "camera").standard_normal(stated.n_unknowns) * stated.apriori_sigma
