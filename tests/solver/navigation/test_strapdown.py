"""The mechanisation against independent integrations, and its derivatives against differences."""

import inertial_flights as sim
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from triline.solver.geometry import earth
from triline.solver.geometry.rotation import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    quaternion_from_vector,
    quaternion_multiply,
    skew,
    vector_from_quaternion,
)
from triline.solver.navigation.carried import gravitation
from triline.solver.navigation.inertial_data import InertialData, cut
from triline.solver.navigation.strapdown import (
    IncrementBlock,
    State,
    gravitation_e,
    integrate,
    integrate_one,
    process_noise,
    propagate,
    rotation_matrix,
    running_product,
    transition,
)

ZERO = np.zeros(3)


def run(state: State, data: InertialData, block_s: float) -> State:
    pieces = data.corrected()
    n = round(block_s / data.interval_s)
    for i in range(0, len(pieces), n):
        b = integrate_one(pieces[i : i + n], ZERO, ZERO)
        state = propagate(state, b.duration_s, b.R, b.v, b.p)
    return state


def local_level(true, start_s, end_s):
    """The textbook's equations, north-east-down with transport rate, by an adaptive integrator of order 8."""
    lat, lon, h = (float(x[0]) for x in (true.at(start_s).lat, true.at(start_s).lon, true.at(start_s).height_m))
    s = true.at(start_s)

    def rates(t, y):
        (lat, _, h), v, q = y[:3], y[3:6], y[6:] / np.linalg.norm(y[6:])
        R_N, R_E = earth.curvature_radii(lat)
        w_ie = earth.ROTATION_RATE * np.array([np.cos(lat), 0.0, -np.sin(lat)])
        w_en = np.array([v[1] / (R_E + h), -v[0] / (R_N + h), -v[1] * np.tan(lat) / (R_E + h)])
        rate, force = (x[0] for x in true.felt(np.array([t])))
        R_nb = matrix_from_quaternion(q)
        g = np.array([-8.14e-9 * h * np.sin(2 * lat), 0.0, float(earth.normal_gravity(lat, h))])
        dv = R_nb @ force - np.cross(2 * w_ie + w_en, v) + g
        dq = 0.5 * quaternion_multiply(q, np.array([*(rate - R_nb.T @ (w_ie + w_en)), 0.0]))
        return np.array([v[0] / (R_N + h), v[1] / ((R_E + h) * np.cos(lat)), -v[2], *dv, *dq])

    y0 = np.array([lat, lon, h, *s.velocity_n[0], *quaternion_from_matrix(s.R_nb[0])])
    # with 1e-11 its own error in velocity is up to 4e-7 m/s in 12 s, by the processor; that of `propagate` is 8e-8
    y = solve_ivp(rates, (start_s, end_s), y0, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    R_en = earth.R_en(y[0], y[1])
    q = y[6:] / np.linalg.norm(y[6:])
    return earth.ecef_from_geodetic(*y[:3]), R_en @ y[3:6], R_en @ matrix_from_quaternion(q)


def test_agrees_with_an_independent_integration_in_the_local_level_frame():
    true = sim.motion(120.0, 3)
    start, end = 64.0, 68.0  # in a turn
    r, v, R = local_level(true, start, end)
    result = run(State(*sim.true_start(true, start)), true.increments(np.linspace(start, end, 1601)), 0.1)
    assert np.linalg.norm(result.r_e - r) < 2e-6
    assert np.linalg.norm(result.v_e - v) < 1e-7
    assert np.linalg.norm(result.R_eb - R) < 7e-9


def test_error_falls_with_the_order_of_the_method():
    true = sim.motion(120.0, 3)
    start, end = 40.0, 100.0
    r, _, R = sim.true_start(true, end)
    attitude, position = [], []
    for hz in (25, 50, 100):
        s = run(State(*sim.true_start(true, start)), true.increments(np.linspace(start, end, 60 * hz + 1)), 0.2)
        attitude.append(np.linalg.norm(s.R_eb - R))
        position.append(np.linalg.norm(s.r_e - r))
    order = np.diff(-np.log2(attitude))
    assert (order > 2.5).all(), (attitude, order)
    assert attitude[-1] < 2e-8
    assert position[-1] < 2e-4


def test_coning_correction_is_worth_an_order():
    true = sim.motion(120.0, 3)
    data = true.increments(np.linspace(40.0, 100.0, 60 * 50 + 1))
    _, _, R = sim.true_start(true, 100.0)
    with_correction = run(State(*sim.true_start(true, 40.0)), data, 0.2)
    blocks = [integrate_one(data[i : i + 10], ZERO, ZERO) for i in range(0, len(data), 10)]
    state = State(*sim.true_start(true, 40.0))
    for b in blocks:
        state = propagate(state, b.duration_s, b.R, b.v, b.p)
    assert np.linalg.norm(with_correction.R_eb - R) < 0.1 * np.linalg.norm(state.R_eb - R)


def test_a_platform_at_rest_stays_and_swings_with_the_schuler_period():
    lat, lon, h = np.radians(47.0), np.radians(9.0), 500.0
    r = earth.ecef_from_geodetic(lat, lon, h)
    R_en = earth.R_en(lat, lon)
    up = R_en.T @ (-gravitation_e(r) - earth.ROTATION_RATE**2 * np.array([r[0], r[1], 0.0]))
    T, step = 5400.0, 2.0
    rate = R_en.T @ np.array([0.0, 0.0, earth.ROTATION_RATE])
    block = integrate_one(
        InertialData.from_rates(np.arange(0.0, step, 0.1) + 0.1, np.tile(rate, (20, 1)), np.tile(up, (20, 1))),
        ZERO,
        ZERO,
    )
    rest, moved = State(r, ZERO, R_en), State(r, R_en @ np.array([0.1, 0.0, 0.0]), R_en)
    north = []
    for _ in range(int(T / step)):
        rest = propagate(rest, step, block.R, block.v, block.p)
        moved = propagate(moved, step, block.R, block.v, block.p)
        north.append((R_en.T @ (moved.r_e - rest.r_e))[0])
    away = R_en.T @ (rest.r_e - r)
    assert np.hypot(away[0], away[1]) < 5e-3
    assert abs(away[2]) < 0.5  # heights are unstable: an error grows 6000 times in this time
    north = np.array(north)
    period = 2 * np.pi * np.sqrt((earth.curvature_radii(lat)[0] + h) / earth.normal_gravity(lat, h))
    quarter = (np.argmax(north) + 1) * step
    assert quarter == pytest.approx(period / 4, rel=0.03)
    crossing = np.flatnonzero(np.diff(np.sign(north[10:])))[0] * step + 10 * step
    assert crossing == pytest.approx(period / 2, rel=0.03)
    # the amplitude of an oscillator: v / omega, with the Foucault rotation slow beside it
    assert north.max() == pytest.approx(0.1 * period / (2 * np.pi), rel=0.03)


def test_gravitation_agrees_with_the_ellipsoid_module():
    rng = np.random.default_rng(0)
    lat, lon, h = rng.uniform(-1.57, 1.57, 50), rng.uniform(-3.1, 3.1, 50), rng.uniform(-100, 12000, 50)
    r = earth.ecef_from_geodetic(lat, lon, h)
    scalar = np.array([gravitation_e(x) for x in r])
    assert np.abs(scalar - gravitation(r)).max() < 1e-9


@pytest.mark.parametrize("blocks", [1, 3])  # one short block is multiplied as plain numbers
def test_running_product_is_the_product_of_all_before(blocks):
    rng = np.random.default_rng(1)
    q = quaternion_from_vector(rng.normal(0, 0.3, (blocks, 13, 3)))
    expected = q[:, 0]
    product = running_product(q)
    for k in range(1, 13):
        expected = quaternion_multiply(expected, q[:, k])
        assert np.abs(product[:, k] - expected).max() < 1e-14


def pieces(n=40, seed=2) -> InertialData:
    rng = np.random.default_rng(seed)
    rate = np.array([0.3, -0.2, 0.5]) + 0.1 * rng.standard_normal((n, 3))
    force = np.array([0.5, 1.0, -9.8]) + rng.standard_normal((n, 3))
    return InertialData.from_rates(100.0 + 0.01 * np.arange(n), rate, force)


def test_two_blocks_after_another_are_the_block_of_both():
    p = pieces()
    whole, parts = (
        integrate_one(p, np.zeros(6), np.zeros(6)),
        integrate_one(p[:17], np.zeros(6), np.zeros(6)).then(integrate_one(p[17:], np.zeros(6), np.zeros(6))),
    )
    for name in IncrementBlock.__dataclass_fields__:
        exact = name not in ("Jv", "Jp", "Bp")  # of derivatives, the trapezoidal rule's accuracy is enough
        a, b = getattr(whole, name), getattr(parts, name)
        assert np.linalg.norm(a - b) <= (1e-13 if exact else 2e-4) * np.linalg.norm(a), name
    empty = IncrementBlock.empty(6).then(whole)
    assert np.allclose(empty.v, whole.v) and np.allclose(empty.Jp, whole.Jp)


def test_blocks_side_by_side_equal_blocks_one_by_one():
    a, b = pieces(20, 3), pieces(12, 4)
    dt, phi, dv = np.zeros((2, 20)), np.zeros((2, 20, 3)), np.zeros((2, 20, 3))
    for i, p in enumerate((a, b)):
        dt[i, : len(p)], phi[i, : len(p)], dv[i, : len(p)] = p.dt_s, p.dtheta, p.dv
    together = integrate(dt, phi, dv).blocks
    for block, p in zip(together, (a, b), strict=True):
        alone = integrate_one(p, ZERO, ZERO)
        assert np.allclose(block.p, alone.p, atol=1e-14) and np.allclose(block.Jv, alone.Jv, atol=1e-14)


def test_derivatives_of_the_integrals_with_respect_to_sensor_errors():
    p, eps = pieces(), 1e-6
    base = integrate_one(p, np.zeros(6), np.zeros(6))
    for k in range(6):
        d = np.zeros(6)
        d[k] = eps
        for gyro, accel in ((d, np.zeros(6)), (np.zeros(6), d)):
            plus, minus = integrate_one(p, gyro, accel), integrate_one(p, -gyro, -accel)
            _, v, q = base.for_errors(gyro, accel)
            for numeric, analytic in (((plus.v - minus.v) / 2, v - base.v), ((plus.p - minus.p) / 2, q - base.p)):
                assert np.linalg.norm(numeric - analytic) < 2e-3 * np.linalg.norm(numeric) + 1e-12, k
            R = base.for_errors(gyro, accel)[0]
            turn = vector_from_quaternion(quaternion_from_matrix(plus.R @ R.T))
            assert np.linalg.norm(turn) < 2e-5 * eps + 1e-12  # what the mean attitude over a piece leaves


def test_transition_matrix_against_differences():
    true = sim.motion(120.0, 3)
    r, v, R = sim.true_start(true, 70.0)
    data = true.increments(70.0 + np.arange(101) / 200.0).corrected()
    state = State(r, v, R)

    def end(x):
        s = State(r + x[:3], v + x[3:6], rotation_matrix(x[6:9]) @ R)
        b = integrate_one(data, x[9:12], x[12:15])
        return propagate(s, b.duration_s, b.R, b.v, b.p)

    F = transition(state, integrate_one(data, ZERO, ZERO))
    scale = np.array([1.0] * 3 + [1e-2] * 3 + [1e-5] * 3 + [1e-6] * 3 + [1e-3] * 3)
    for k in range(15):
        dx = np.zeros(15)
        dx[k] = scale[k]
        plus, minus = end(dx), end(-dx)
        turn = 0.5 * vector_from_quaternion(quaternion_from_matrix(plus.R_eb @ minus.R_eb.T))
        numeric = np.concatenate([(plus.r_e - minus.r_e) / 2, (plus.v_e - minus.v_e) / 2, turn])
        assert np.allclose(numeric, F[:9, k] * scale[k], rtol=3e-4, atol=1e-8 if k < 3 else 3e-9), k
    assert np.allclose(F[9:, 9:], np.eye(6))


def test_process_noise_against_many_short_blocks():
    true = sim.motion(120.0, 3)
    state = State(*sim.true_start(true, 30.0))
    data = true.increments(30.0 + np.arange(101) / 200.0).corrected()
    whole = process_noise(state, integrate_one(data, ZERO, ZERO), 1e-10, 1e-6)
    P, s = np.zeros((9, 9)), state
    for i in range(100):
        b = integrate_one(data[i : i + 1], ZERO, ZERO)
        F = transition(s, b)[:9, :9]
        P = F @ P @ F.T + process_noise(s, b, 1e-10, 1e-6)
        s = propagate(s, b.duration_s, b.R, b.v, b.p)
    size = np.sqrt(np.diag(P))
    assert np.abs((whole - P) / np.outer(size, size)).max() < 0.03


def test_cutting_keeps_what_was_measured():
    p = pieces(20)
    parts, sample = cut(p, [p.time_s[3] - 0.004, p.time_s[3] - 0.001, p.time_s[7], 0.0, 1e9])
    assert len(parts) == 22
    for name in ("dtheta", "dv"):
        assert np.allclose(np.add.reduceat(getattr(parts, name), np.searchsorted(sample, range(20))), getattr(p, name))
    assert np.allclose(np.diff(parts.time_s), parts.dt_s[1:])


def test_gaps_are_found_and_filled_with_noise():
    p = pieces(100)
    holed = InertialData.from_rates(
        np.delete(p.time_s, range(30, 60)),
        np.delete(p.dtheta / p.dt_s[:, None], range(30, 60), 0),
        np.delete(p.dv / p.dt_s[:, None], range(30, 60), 0),
    )
    ((a, b),) = holed.gaps()
    assert (a, b) == (pytest.approx(p.time_s[29]), pytest.approx(p.time_s[59]))
    full = holed.bridged(0.05, 0.5)
    assert not full.gaps() and len(full) == 100
    assert (full.gyro_psd[30:60] >= 0.05**2 * 0.3 * 0.999).all() and not full.gyro_psd[:30].any()
    block = integrate_one(full, ZERO, ZERO)
    assert block.gyro_variance == pytest.approx(float((full.gyro_psd * full.dt_s).sum()))
    assert p.bridged(0.05, 0.5) is p


def test_a_stamp_that_is_late_is_no_gap():
    p = pieces(100)
    late = p.time_s.copy()
    late[40] += 0.8 * p.interval_s
    of_late = InertialData.from_increments(late, p.dtheta, p.dv)
    assert not of_late.gaps() and of_late.dt_s.sum() == pytest.approx(p.dt_s.sum())
    lost = InertialData.from_increments(*(np.delete(x, 41, 0) for x in (late, p.dtheta, p.dv)))
    assert len(lost.gaps()) == 1


@pytest.mark.parametrize(
    ("time_s", "rate", "words"),
    [
        ([0.0], [[0, 0, 0]], "at least 2"),
        ([0.0, 1.0], [[0, 0, 0]], "do not match"),
        ([0.0, 1.0], [[0, 0, 0], [0, np.nan, 0]], "not finite"),
        ([1.0, 1.0], [[0, 0, 0], [0, 0, 0]], "must increase"),
    ],
)
def test_bad_inertial_data_are_refused_in_words(time_s, rate, words):
    with pytest.raises(ValueError, match=words):
        InertialData.from_rates(time_s, rate, np.zeros((len(time_s), 3)))


def test_rotation_matrix_of_small_and_large_vectors():
    for v in ([1e-7, 2e-7, -1e-7], [0.3, -1.0, 2.0], [0.0, 0.0, 0.0]):
        v = np.array(v)
        assert np.allclose(rotation_matrix(v), matrix_from_quaternion(quaternion_from_vector(v)), atol=1e-15)
    assert np.allclose(rotation_matrix(np.array([0, 0, 1e-5])) - np.eye(3), skew([0, 0, 1e-5]), atol=1e-9)
