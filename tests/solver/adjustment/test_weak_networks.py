"""Networks that cannot be adjusted as they are: an answer in words or one line of refusal, no error of algebra."""

import numpy as np
import pytest

from triline.solver.adjustment.job import Job, NotAdjustableError, run
from triline.solver.adjustment.network import Measurements, build_network
from triline.solver.adjustment.network_weakness import describe, undetermined, word
from triline.solver.camera.self_calibration import tls
from triline.solver.camera.sensors import preset
from triline.solver.models.dgr import DgrOptions
from triline.solver.models.lim import LimOptions
from triline.solver.models.ppm import PpmOptions
from triline.solver.simulation.network import parallel_and_cross, scatter_points, simulate_network

CAMERA = preset("ads40")
MODEL = DgrOptions((0.1, 0.1, 0.2), (0.005, 0.005, 0.008), (0.005, 0.005, 0.008))
FREE = DgrOptions((np.inf,) * 3, (np.inf,) * 3, (np.inf,) * 3)


def ground(n, seed=1):
    rng = np.random.default_rng(seed)
    return scatter_points(n, (-1500, 1500, -1200, 1200), lambda x, y: 60 * np.sin(x / 400 + y / 700), rng)


def block(points, control=(), strips=2, cross=1, seed=1, errors=MODEL, roles=None):
    roles = roles or dict.fromkeys(control, "control")
    lines = parallel_and_cross(CAMERA, 2000.0, strips, cross, 3000.0)
    return simulate_network(CAMERA, lines, points, roles, [], errors, np.random.default_rng(seed))


def with_rays(network, keep):
    """The same network with some of its rays only."""
    columns = (getattr(network.rays, name)[keep] for name in Measurements.__dataclass_fields__)
    return build_network(network.camera, network.strips, network.point_ids, Measurements(*columns), network.control)


def words(result):
    return [c.words for c in result.weak]


def errors_in_sigmas(simulated, result):
    ratio = (result.adjusted_points() - simulated.points_l) / result.point_sigma_m
    return float(np.sqrt(np.nanmean(ratio**2)))


def test_strong_network_has_nothing_undetermined():
    result = run(block(ground(60), control=range(6)).network, Job(MODEL))
    assert words(result) == []


def test_no_control_rests_on_the_trajectories():
    simulated = block(ground(60))
    result = run(simulated.network, Job(MODEL))
    assert {"X offset of all strips", "Y offset of all strips", "flying height of all strips"} <= set(words(result))
    assert 0.5 < errors_in_sigmas(simulated, result) < 2.0


def test_control_in_one_corner_gives_sigmas_that_grow_away_from_it():
    points = ground(80)
    distance = np.linalg.norm(points[:, :2] - (-1500, -1200), axis=1)
    simulated = block(points, control=np.argsort(distance)[:4])
    result = run(simulated.network, Job(MODEL))
    away = np.linalg.norm(simulated.points_l[:, :2] - (-1500, -1200), axis=1)
    sigma = result.point_sigma_m[:, 2]
    assert sigma[away > 2500].mean() > 1.5 * sigma[away < 1000].mean()
    assert 0.5 < errors_in_sigmas(simulated, result) < 2.0


def test_one_strip_without_gnss_weight_and_without_control():
    loose = DgrOptions((np.inf,) * 3, MODEL.shift_sigma_deg, MODEL.drift_sigma_deg)
    result = run(block(ground(60), strips=1, cross=0).network, Job(loose))
    assert {"X offset of strip S1", "Y offset of strip S1"} <= set(words(result))
    assert any(text.startswith("flying height of strip S1") for text in words(result))
    assert np.isfinite(result.adjusted_points()).all()


def test_one_strip_without_gnss_weight_is_held_by_control():
    simulated = block(ground(60), control=range(6), strips=1, cross=0)
    loose = DgrOptions((np.inf,) * 3, MODEL.shift_sigma_deg, MODEL.drift_sigma_deg)
    result = run(simulated.network, Job(loose))
    assert words(result) == []
    assert 0.5 < errors_in_sigmas(simulated, result) < 1.7


@pytest.mark.parametrize("model", [MODEL, FREE, LimOptions(), PpmOptions()], ids=["dgr", "free", "lim", "ppm"])
def test_collinear_points(model):
    line = np.column_stack([np.linspace(-1500, 1500, 40), np.zeros(40), np.zeros(40)])
    result = run(block(line, control=(0, 20, 39), strips=1, cross=0).network, Job(model, snoop=True))
    assert np.isfinite(result.sigma0)
    both = [text for text in words(result) if "Y" in text and "omega" in text]
    assert both, "points on a line leave the roll about it open"


def test_free_datum_names_what_is_free():
    result = run(block(ground(60)).network, Job(FREE))
    assert len(result.solution.factor.undetermined) >= 3
    assert {"X offset of all strips", "Y offset of all strips", "flying height of all strips"} <= set(words(result))


def test_free_datum_with_control_is_a_sound_network():
    simulated = block(ground(60), control=range(6))
    result = run(simulated.network, Job(FREE))
    assert words(result) == [] and len(result.solution.factor.undetermined) == 0
    assert 0.5 < errors_in_sigmas(simulated, result) < 1.7


@pytest.mark.parametrize("model", [MODEL, FREE, LimOptions(), PpmOptions()], ids=["dgr", "free", "lim", "ppm"])
@pytest.mark.parametrize("control", [(), (0,), (0, 1)], ids=["none", "one", "two"])
def test_two_points_only(model, control):
    simulated = block(ground(2, seed=3), control=control, strips=1, cross=0)
    job = Job(model, self_calibration=tls(CAMERA).free(), snoop=True, reweight=True, components=True)
    result = run(simulated.network, job)
    assert result.weak or result.removed  # what elimination leaves may just be determined
    assert np.isfinite(result.adjusted_points()).all()
    assert all(r.reason for r in result.removed)
    if model is not FREE:
        assert errors_in_sigmas(simulated, result) < 4.0


def test_parameters_correlated_to_one_are_eliminated_with_the_reason():
    """A flat strip without control: the camera constant does what the flying height does."""
    loose = DgrOptions((10.0, 10.0, 10.0), (1.0, 1.0, 1.0), (1.0, 1.0, 1.0))
    flat = ground(60)
    flat[:, 2] = 0.0
    simulated = block(flat, control=range(2), strips=1, cross=0)
    result = run(simulated.network, Job(loose, self_calibration=tls(CAMERA).free()))
    reasons = {r.name: r.reason for r in result.removed}
    assert "dc" in reasons and all(reasons.values())
    assert result.solution.layout.n_camera <= 4


def test_parameters_kept_by_force_are_named_with_their_partners():
    simulated = block(ground(60), strips=2, cross=0)
    result = run(simulated.network, Job(MODEL, self_calibration=tls(CAMERA).free(), eliminate=False))
    together = [text for text in words(result) if text.count(" with ")]
    assert any("camera constant" in text for text in together)
    assert any("kappa shift of all strips" in text and "inclination of line" in text for text in together)


def test_points_seen_once_and_no_control_is_refused_in_one_line():
    network = block(ground(20)).network
    first = network.first_ray[:-1]
    lonely = with_rays(network, first)
    with pytest.raises(NotAdjustableError, match="no object point is seen by two rays"):
        run(lonely, Job(MODEL))


def test_points_seen_once_beside_others_have_no_coordinates():
    network = block(ground(30), control=range(5)).network
    p = next(i for i in range(30) if i not in network.control.point)
    keep = np.ones(len(network.rays), dtype=bool)
    keep[network.first_ray[p] + 1 : network.first_ray[p + 1]] = False
    poorer = with_rays(network, keep)
    result = run(poorer, Job(MODEL, snoop=True))
    place = poorer.point_index[network.point_ids[p]]
    assert np.isnan(result.adjusted_points()[place]).all() and np.isnan(result.point_sigma_m[place]).all()
    assert np.isfinite(np.delete(result.adjusted_points(), place, axis=0)).all()


def test_planimetric_and_height_control_only():
    points = ground(60)
    roles = {i: ("planimetric", "height")[i % 2] for i in range(8)}
    simulated = block(points, roles=roles)
    result = run(simulated.network, Job(MODEL))
    assert words(result) == []
    assert 0.5 < errors_in_sigmas(simulated, result) < 1.7


def test_undetermined_finds_a_known_null_vector():
    """x1 - x2 is observed, x1 + x2 is known a priori only, x3 is observed well."""
    A = np.array([[1.0, -1.0, 0.0], [0.0, 0.0, 5.0]])
    N = A.T @ A
    names = ("X offset of strip S1", "X offset of strip S2", "kappa drift of strip S2")
    found = undetermined(N, np.eye(3) * 1e-3, np.diag(N), names, 2)
    assert [c.words for c in found] == ["X offset of all strips"]
    assert found[0].share < 1e-9 and set(found[0].unknowns) == set(names[:2])


def test_undetermined_of_no_information_at_all():
    names = ("kappa drift of strip S2", "dc")
    found = undetermined(np.zeros((2, 2)), np.zeros((2, 2)), np.zeros(2), names, 1)
    assert {c.words for c in found} == {"kappa drift of strip S2", "camera constant"}


@pytest.mark.parametrize(
    ("unknowns", "sets", "text"),
    [
        (("kappa drift of strip S2",), 3, "kappa drift of strip S2"),
        (("dc", "Z offset of strip S1"), 1, "camera constant with flying height of strip S1"),
        (("Z offset of strip A", "Z offset of strip B", "dc"), 2, "flying height of all strips with camera constant"),
        (("X at fix 5 of strip S1", "X at fix 6 of strip S1"), 2, "X at fix 5, 6 of strip S1"),
        (("th_F", "kappa shift of strip S1"), 2, "inclination of line F with kappa shift of strip S1"),
        (("X offset of strip S1", "X offset of strip S3"), 4, "X offset of strip S1 and S3"),
    ],
)
def test_combinations_in_words(unknowns, sets, text):
    assert describe(unknowns, sets) == text


def test_words_of_parameters():
    assert (
        word("sy_B") == "scale of line B" and word("k2") == "radial distortion k2" and word("phi shift") == "phi shift"
    )


def test_parameter_without_pivot_is_removed_with_what_it_cannot_be_told_from():
    """Free scale of all lines and free camera constant: one of them is the others together."""
    result = run(block(ground(60), control=range(6)).network, Job(MODEL, self_calibration=tls(CAMERA).free()))
    first = result.removed[0]
    assert first.name == "dc" and first.criterion == "pivot"
    assert "not to be told from" in first.reason and "scale of line" in first.reason
