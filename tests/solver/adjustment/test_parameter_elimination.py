"""Parameters taken out of the cofactors one after another, against the network adjusted anew without each."""

from dataclasses import replace

import numpy as np
import pytest
from adjustment_networks import CAMERA, simulate

from triline.solver.adjustment.adjustment import AdjustmentOptions, pose_problem, solve
from triline.solver.adjustment.determinability import Limits, examine
from triline.solver.adjustment.job import Job, run
from triline.solver.adjustment.parameter_elimination import Reduced, eliminate
from triline.solver.camera.self_calibration import tls
from triline.solver.models.dgr import DgrOptions
from triline.solver.models.slow_errors import SlowErrors
from triline.solver.models.wander import WanderOptions

MODEL, PARAMETERS = DgrOptions(), tls(CAMERA)
#: True values of parameters; those of the others are zero.
ERRORS = {"k1": 3e-6, "xp_F": 0.004, "sy_B": 1e-4}


@pytest.fixture(scope="module")
def full():
    network = simulate(
        4, MODEL, points=150, strips=2, cross=1, length_m=4000.0, self_calibration=PARAMETERS, camera_parameters=ERRORS
    ).network
    return solve(pose_problem(network, MODEL, PARAMETERS))


def anew(full, gone):
    """The evidence of the network adjusted without parameters, places and weights of rays taken where they are then."""
    found = solve(pose_problem(full.network, MODEL, PARAMETERS.without(gone)))
    return Reduced.of(solve(found.problem, found.state)).evidence


def test_what_is_left_is_what_an_adjustment_without_the_parameters_says(full):
    known, gone = Reduced.of(full), []
    for _ in range(6):
        verdict = examine(known.evidence, Limits())
        assert verdict.removal is not None
        gone.append(verdict.removal.name)
        known = known.without(gone[-1])
        assert known is not None
    ours, theirs = known.evidence, anew(full, gone)
    assert ours.names == theirs.names and ours.redundancy == theirs.redundancy and ours.partner == theirs.partner
    assert ours.sigma0 == pytest.approx(theirs.sigma0, rel=1e-5)
    assert np.abs(ours.t - theirs.t).max() < 0.02
    np.testing.assert_allclose(ours.sigma, theirs.sigma, rtol=1e-3)
    np.testing.assert_allclose(ours.correlation, theirs.correlation, rtol=1e-3)
    np.testing.assert_allclose(ours.pivot, theirs.pivot, rtol=2e-3)
    np.testing.assert_allclose(ours.point_sigma_m, theirs.point_sigma_m, rtol=1e-3)


def test_the_parameters_that_go_are_those_that_adjustments_after_each_would_name(full):
    outcome = eliminate(full)
    gone = []
    while (verdict := examine(anew(full, gone) if gone else Reduced.of(full).evidence)).removal is not None:
        gone.append(verdict.removal.name)
    assert [r.name for r in outcome.removed] == gone and len(gone) > 6
    assert outcome.kept.keys() == verdict.kept.keys()
    # and the adjustment is that without them
    end = solve(outcome.solution.problem, outcome.solution, options=AdjustmentOptions())
    found = solve(pose_problem(full.network, MODEL, PARAMETERS.without(gone)))
    for _ in range(4):  # places and weights are those of the start
        found = solve(found.problem, found.state)
    sigma = np.sqrt(found.factor.variances())
    assert np.abs((end.state.theta - found.state.theta) / sigma).max() < 1e-4
    assert end.cost == pytest.approx(found.cost, rel=1e-5)


def test_what_only_the_pivot_tells_apart_or_lies_far_from_zero_is_adjusted_anew(full):
    known = Reduced.of(full)
    t = np.abs(known.theta[known.solution.layout.n_model :]) / np.sqrt(np.diag(Reduced.of(full).evidence.cofactors))
    near, far = known.names[int(np.argmin(t))], known.names[int(np.argmax(t))]
    assert t.max() > 10.0 and known.without(near) is not None and known.without(far) is None


def test_what_the_model_leaves_out_counts_once_however_many_parameters_go():
    wander = SlowErrors((0.1, 0.1, 0.2), (1e-4,) * 3, (1e-4,) * 3, (0.1, 0.1, 0.2), (2e-4,) * 3, 80.0)
    model = WanderOptions(wander, left_out_m=0.05, left_out=1e-4)
    network = simulate(5, MODEL, points=80).network
    plain = pose_problem(network, model)
    assert plain.network.rays.orientation_noise is not None and plain.network.rays.orientation_noise.max() > 0.0
    found = eliminate(solve(pose_problem(network, model, PARAMETERS)), Limits(), AdjustmentOptions())
    assert found.removed
    noise = found.solution.network.rays.orientation_noise
    np.testing.assert_allclose(noise, plain.network.rays.orientation_noise, rtol=1e-9, atol=1e-18)


@pytest.mark.parametrize("stated", [1.0 / 3.0, 3.0])
@pytest.mark.parametrize(
    "asked", [{"reweight": True}, {"reweight": True, "snoop": True}, {"components": True, "snoop": True}], ids=str
)
def test_an_image_sigma_that_was_estimated_holds_when_parameters_go(full, asked, stated):
    """The problem posed anew had the a-priori one: sigma0 was 3 and a third, and sigma0 in pixels as much too large."""
    rays = full.network.rays
    wrong = replace(rays, sigma_line_px=stated * rays.sigma_line_px, sigma_sample_px=stated * rays.sigma_sample_px)
    result = run(replace(full.network, rays=wrong), Job(MODEL, self_calibration=PARAMETERS, **asked))
    assert len(result.removed) > 6
    assert result.image_factor == pytest.approx(1.0 / stated, rel=0.05)
    assert result.solution.sigma0 == pytest.approx(1.0, abs=0.03)
