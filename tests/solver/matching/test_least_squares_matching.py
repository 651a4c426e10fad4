"""What least squares matching says about its own accuracy, and poses without their noise."""

import numpy as np
import pytest
from scipy.ndimage import uniform_filter

from triline.solver.geometry.rotation import (
    quaternion_conjugate,
    quaternion_from_vector,
    quaternion_multiply,
    vector_from_quaternion,
)
from triline.solver.matching import least_squares
from triline.solver.matching.chips import CHIP_BYTES, CHIP_HALF, ChipStore
from triline.solver.matching.least_squares import match_patches
from triline.solver.matching.patches import Windows, any_of, interpolate_stack
from triline.solver.matching.pose_smoothing import PoseSmoother
from triline.solver.matching.search import Ground


def pairs(k, noise, texture, seed=1, n=27):
    """Templates and search patches (k, n, n) resampled out of noisy images, and the shift between them (k, 2)."""
    rng = np.random.default_rng(seed)
    f = np.hypot(np.fft.fftfreq(64)[:, None], np.fft.fftfreq(64)[None, :])
    spectrum = np.fft.fft2(rng.standard_normal((k, 64, 64))) * np.exp(-0.5 * (f / texture) ** 2)
    spectrum /= np.fft.ifft2(spectrum).real.std()
    shift = rng.uniform(-0.8, 0.8, (k, 2))
    y, x = np.meshgrid(np.arange(n) + 15.0, np.arange(n) + 15.0, indexing="ij")
    out = []
    for moved in (np.zeros((k, 2)), shift):
        phase = rng.uniform(-0.5, 0.5, (k, 2))
        turn = np.fft.fftfreq(64)[:, None] * (moved + phase)[:, 0, None, None]
        turn = turn + np.fft.fftfreq(64)[None, :] * (moved + phase)[:, 1, None, None]
        image = np.fft.ifft2(spectrum * np.exp(-2j * np.pi * turn)).real * 300 + noise * rng.standard_normal(
            (k, 64, 64)
        )
        out.append(
            interpolate_stack(image.astype(np.float32), y + phase[:, 0, None, None], x + phase[:, 1, None, None])
        )
    return out[0][:, 4:-4, 4:-4].copy(), out[1], shift


def test_constants_of_the_covariance_are_those_of_the_resampling(monkeypatch):
    """SMOOTHED and SHORTFALL against simulated white noise."""
    a = np.linspace(0, 1, 2001)
    s2, s3 = a * a, a**3
    taps = 0.5 * np.array([2 * s2 - s3 - a, 3 * s3 - 5 * s2 + 2, 4 * s2 - 3 * s3 + a, s3 - s2])
    once = float((taps**2).sum(axis=0).mean()) ** 2
    assert 0.5 * (once + once**0.5) == pytest.approx(least_squares.SMOOTHED, abs=0.02)
    kept = {}
    shown = least_squares._shift_covariance

    def spy(design, weight, left, t):
        kept.update(design=design, weight=weight, left=left)
        return shown(design, weight, left, t)

    monkeypatch.setattr(least_squares, "_shift_covariance", spy)
    template, search, shift = pairs(200, 1.0, 0.08)
    match_patches(template, search, np.zeros_like(shift), iterations=20)
    design, weight, box, t = kept["design"], kept["weight"], least_squares.BOX, 19
    normal = np.swapaxes(design, 1, 2) @ (design * weight[:, :, None])
    cofactors = np.linalg.inv(normal + 1e-6 * np.einsum("kii->ki", normal)[:, :, None] * np.eye(8))
    fit = (cofactors @ np.swapaxes(design, 1, 2)) * weight
    noise = np.random.default_rng(3).standard_normal((len(design), t * t, 1))
    left = noise - design @ (fit @ noise)
    gain = fit[:, [0, 3]]
    moves = np.pad((gain * left[:, :, 0][:, None]).reshape(-1, 2, t, t), ((0, 0), (0, 0), (box, box), (box, box)))
    boxes = ((box * uniform_filter(moves, box, mode="constant", axes=(2, 3))) ** 2).sum(axis=(1, 2, 3))
    assert (gain**2).sum() / boxes.sum() == pytest.approx(least_squares.SHORTFALL, rel=0.1)


def test_windows_know_what_is_missing():
    values = np.arange(2 * 12 * 12, dtype=np.float32).reshape(2, 12, 12)
    lines, samples = np.ones((2, 12), bool), np.ones((2, 12), bool)
    lines[0, 5] = samples[1, 3] = False
    windows = Windows(np.array([100, 200]), np.array([7, 9]), values, lines, samples, np.zeros_like(lines))
    line, sample = np.array([[104.0], [208.0]]), np.array([[12.5], [14.5]])
    got, known = windows.sample(line, sample, cubic=True)
    assert not known[0, 0] and known[1, 0]
    assert got[1, 0] == pytest.approx(values[1, 8, 5] + 0.5, abs=1e-3)
    half = windows.reduced(2)
    got, known = half.sample(line + 3, sample, cubic=False)
    assert known[0, 0] and got[0, 0] == pytest.approx(values[0, 7, 5] + 0.5, abs=1e-3)


def test_chips_stay_within_their_budget():
    store = ChipStore(20 * CHIP_BYTES)
    side = 2 * CHIP_HALF + 1
    for i in range(5):
        ground = Ground(np.full((8, 3), float(i)), np.array([1.0, 0.0]), np.array([0.0, 1.0]), 1.0)
        names = [f"S{i}-M{j}" for j in range(8)]
        store.add(f"S{i}", names, np.full((8, side, side), 7.0 * i), ground, np.ones(8))
    assert len(store) <= 20 and store.nbytes <= store.budget
    assert all(len(s.names) == len(s.values) == len(s.xyz_l) == len(s.score) >= 2 for s in store.strips.values())
    assert store.strips["S3"].values.max() == 21


def test_poses_lose_their_noise_and_keep_their_motion():
    rng = np.random.default_rng(1)
    time_s = np.arange(0, 6, 0.005)
    swing = 0.02 * np.sin(2 * np.pi * 1.5 * time_s)[:, None] * [1.0, 0.5, -1.0]
    true = quaternion_from_vector(swing)
    noise = 2e-5 * rng.standard_normal(swing.shape)
    noisy = quaternion_multiply(true, quaternion_from_vector(noise))
    position = np.column_stack([70 * time_s, np.sin(time_s), 1500 + 0 * time_s])
    measured = position + 0.01 * rng.standard_normal(position.shape)
    smoother, covariance = PoseSmoother(), np.broadcast_to(np.eye(6), (len(time_s), 6, 6))
    out_s, out_l, out_q, _ = smoother.push(time_s, measured, noisy, covariance)
    assert smoother.reach == (8, 8) and len(out_s) == len(time_s) - 8
    index = np.rint(out_s / 0.005).astype(int)
    left = vector_from_quaternion(quaternion_multiply(quaternion_conjugate(true[index]), out_q))[200:]
    assert 0.3 < left.std() / 2e-5 < 0.5  # sqrt of the middle weight of 17 is 0.37
    assert np.std((out_l - position[index])[200:]) < 0.005
    expected = np.repeat([0.01**2, 2e-5**2], 3) * 0.137
    np.testing.assert_allclose(smoother.noise_left, expected, rtol=0.4)
    # motion as fast as the poses is kept
    shaking = PoseSmoother()
    shake = quaternion_from_vector(1e-3 * np.sin(2 * np.pi * 20 * time_s[:400])[:, None] * [1.0, 0.0, 0.0])
    shaking.push(time_s[:400], position[:400], quaternion_multiply(noisy[:400], shake), covariance[:400])
    assert shaking.reach[1] < 8


def test_poses_come_out_the_same_however_many_come_at_once():
    rng = np.random.default_rng(3)
    n = 700
    time_s = np.cumsum(np.where(rng.uniform(size=n) < 0.01, 0.02, 0.005))  # some are missing
    position = np.column_stack([70 * time_s, 3 * np.sin(time_s), 1500 + rng.standard_normal(n) * 0.01])
    turns = 0.02 * np.sin(time_s)[:, None] + 2e-5 * rng.standard_normal((n, 3))
    rows = time_s, position, quaternion_from_vector(turns), np.broadcast_to(np.eye(6), (n, 6, 6))
    found = []
    for sizes in ([1] * n, [n], [5, 12, 40, 1, 200, n - 258]):
        smoother, ends = PoseSmoother(), np.cumsum(sizes)
        parts = [smoother.push(*(c[e - k : e] for c in rows)) for k, e in zip(sizes, ends, strict=True)]
        parts.append(smoother.rest())
        found.append(([np.concatenate(column) for column in zip(*parts, strict=True)], smoother.noise_left))
    (alone, noise), *others = found
    np.testing.assert_array_equal(alone[0], time_s)
    assert 0.001 < np.abs(alone[1] - position).max() < 0.1
    for columns, other_noise in others:
        np.testing.assert_array_equal(other_noise, noise)
        for one, other in zip(alone, columns, strict=True):
            np.testing.assert_array_equal(one, other)


def test_least_squares_matching_finds_shifts():
    rng = np.random.default_rng(2)
    n, k = 27, 150
    f = np.hypot(np.fft.fftfreq(64)[:, None], np.fft.fftfreq(64)[None, :])
    spectrum = np.fft.fft2(rng.standard_normal((k, 64, 64))) * np.exp(-0.5 * (f / 0.2) ** 2)
    shift = rng.uniform(-0.8, 0.8, (k, 2))
    phase = np.exp(-2j * np.pi * (np.fft.fftfreq(64)[:, None] * shift[:, 0, None, None]
                                  + np.fft.fftfreq(64)[None, :] * shift[:, 1, None, None]))  # fmt: skip
    first, second = (np.fft.ifft2(s).real[:, :n, :n] * 800 for s in (spectrum, spectrum * phase))
    first, second = (a + 15 * rng.standard_normal(a.shape) for a in (first, 0.8 * second + 100))
    found = match_patches(first[:, 4:-4, 4:-4].astype(np.float32), second.astype(np.float32), np.zeros((k, 2)))
    error = found.shift - shift
    assert found.converged.all() and np.abs(error.mean(axis=0)).max() < 0.01
    assert np.sqrt((error**2).mean()) < 0.08
    assert (found.score > 0.9).mean() > 0.9


def test_what_was_not_measured_does_not_matter_whatever_its_grey_values():
    rng = np.random.default_rng(5)
    k, t, s = 300, 19, 27
    f = np.hypot(np.fft.fftfreq(64)[:, None], np.fft.fftfreq(64)[None, :])
    spectrum = np.fft.fft2(rng.standard_normal((k, 64, 64))) * np.exp(-0.5 * (f / 0.12) ** 2)
    shift = rng.uniform(-0.4, 0.4, (k, 2))
    phase = np.exp(-2j * np.pi * (np.fft.fftfreq(64)[:, None] * shift[:, 0, None, None]
                                  + np.fft.fftfreq(64)[None, :] * shift[:, 1, None, None]))  # fmt: skip
    first, second = (np.fft.ifft2(a).real[:, :s, :s] * 1500 for a in (spectrum, spectrum * phase))
    template, search = (a + 1000 + 40 * rng.standard_normal(a.shape) for a in (first, second))
    template = template[:, 4:-4, 4:-4].astype(np.float32)
    holes = np.zeros((k, t, t), bool), np.zeros((k, s, s), bool)
    holes[0][:, 4:7], holes[1][:, :, 15:17] = True, True
    between = search.copy()
    for i, share in ((15, 1 / 3), (16, 2 / 3)):  # as a mended patch has them
        between[:, :, i] = (1 - share) * search[:, :, 14] + share * search[:, :, 17]
    a = match_patches(template, between.astype(np.float32), np.zeros((k, 2)), holes=holes)
    spoilt = np.where(holes[0], 4095, template).astype(np.float32)
    b = match_patches(spoilt, between.astype(np.float32), np.zeros((k, 2)), holes=holes)
    np.testing.assert_allclose(a.shift, b.shift, atol=1e-9)
    np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-6)
    assert ((a.measured > 0.6) & (a.measured < 0.8)).all() and a.converged.all()
    # and the covariance tells what is left, as that of whole patches does
    whole = match_patches(template, search.astype(np.float32), np.zeros((k, 2)))
    error = a.shift - shift
    normalised = [
        np.einsum("ki,kij,kj->k", x.shift - shift, np.linalg.inv(x.covariance), x.shift - shift).mean()
        for x in (a, whole)
    ]
    # 2, and what shifts lean by until a patch is taken anew from where it was found
    assert 0.8 < normalised[0] / normalised[1] < 1.25 and 1.0 < normalised[1] < 4.5
    assert 1.05 < np.median(a.covariance[:, 0, 0] / whole.covariance[:, 0, 0]) < 2.5
    # without the holes the same patches are spoilt
    blind = match_patches(spoilt, between.astype(np.float32), np.zeros((k, 2)))
    assert np.abs(blind.shift - shift).mean() > 2 * np.abs(error).mean()


@pytest.mark.parametrize("factor", range(1, 10))
def test_pixels_that_are_put_together_are_the_mean_and_any_of_their_block(factor):
    """As NumPy adds them, which is slow for small blocks; what makes no whole block is left out."""
    rng = np.random.default_rng(factor)
    values, (k, n, m) = rng.normal(900.0, 300.0, (5, 47, 53)).astype(np.float32), (5, 47 // factor, 53 // factor)
    there = [np.ones((k, size), dtype=bool) for size in values.shape[1:]]
    none = np.zeros(k, dtype=np.int64)
    of = lambda a: a[:, : n * factor, : m * factor].reshape(k, n, factor, m, factor)  # noqa: E731
    reduced = Windows(none, none, values, *there, ~there[0]).reduced(factor)
    np.testing.assert_allclose(reduced.values, of(values).mean(axis=(2, 4)), rtol=5e-7)
    assert reduced.values.dtype == np.float32 and reduced.factor == factor
    holes = values > 1800.0
    np.testing.assert_array_equal(any_of(holes, factor), of(holes).any(axis=(2, 4)))
