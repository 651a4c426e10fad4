"""Radiometric balance: gains, offsets and fall-off come back, with errors as large as their sigmas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from triline.solver.orthoimage.tone_balance import ToneBalance, ToneSamples, balance, held_out


def _drawn(seed: int, fall_off: tuple[float, float], moved: float = 0.05, layers: int = 5, places: int = 600):
    rng = np.random.default_rng(seed)
    gain = 1.0 + 0.15 * rng.normal(size=layers)
    gain /= gain.mean()
    offset = 20.0 * rng.normal(size=layers)
    offset -= offset.mean()
    place, layer, value, off = [], [], [], []
    for k in range(places):
        first = rng.integers(0, layers - 1)
        seen = [first, first + 1] if rng.random() < 0.7 else list(rng.choice(layers, 3, replace=False))
        radiance, error = rng.uniform(200, 900), 6.0 * rng.normal(size=len(seen))
        if rng.random() < moved:
            error[0] += rng.uniform(50, 300)
        for i, e in zip(seen, error, strict=True):
            s = rng.uniform(0.2, 1.0)
            place.append(k)
            layer.append(i)
            off.append(s)
            shape = 1.0 + fall_off[0] * s**2 + fall_off[1] * s**4
            value.append(gain[i] * shape * radiance + offset[i] + e)
    samples = ToneSamples(np.array(place), np.array(layer), np.array(value), np.array(off), np.arange(places) // 15)
    return samples, gain, offset


@pytest.mark.parametrize("fall_off", [(0.0, 0.0), (-0.2, -0.1)])
def test_errors_are_as_large_as_their_sigmas(fall_off):
    squares = []
    for seed in range(30):
        samples, gain, offset = _drawn(seed, fall_off)
        found = balance(samples, np.zeros(5, dtype=int), np.array([fall_off[0] != 0]))
        error = [found.gain - gain, found.offset - found.mean_offset[0] - offset]
        sigma = [found.gain_sigma, found.relative_offset_sigma]
        if fall_off[0]:
            error.append(found.fall_off[0] - fall_off)
            sigma.append(found.fall_off_sigma[0])
        assert found.sigma0 == pytest.approx(6.0, rel=0.12)
        assert 10 <= found.refused <= 45  # of some 30 where something moved
        squares.append((np.concatenate(error) / np.concatenate(sigma)) ** 2)
    mean = np.mean(squares, axis=0)
    assert 0.6 < mean.mean() < 1.5
    assert (mean < 2.6).all() and (mean > 0.25).all()


def test_radiance_undoes_what_was_put_in():
    samples, gain, offset = _drawn(3, (-0.2, -0.1), moved=0.0)
    found = balance(samples, np.zeros(5, dtype=int), np.array([True]))
    s = np.linspace(0, 1, 11)
    seen = gain[2] * (1 - 0.2 * s**2 - 0.1 * s**4) * 500.0 + offset[2]
    np.testing.assert_allclose(found.radiance(2, seen, s), 500.0, atol=8.0)
    none = ToneBalance.none(np.zeros(5, dtype=int))
    np.testing.assert_array_equal(none.radiance(1, np.array([7.0, 9.0]), np.array([0.5, 1.0])), [7.0, 9.0])


@pytest.mark.parametrize("fall_off", [False, True])
def test_places_that_a_balance_was_not_computed_from_say_what_it_is_worth(fall_off):
    """A balance by places of other ground made steps of tone larger."""
    camera, estimated = np.zeros(5, dtype=int), np.array([fall_off])
    for seed in range(8):
        rng = np.random.default_rng(seed)
        samples, _, _ = _drawn(seed, (0.0, 0.0), places=400)
        assert held_out(samples, camera, estimated) > 4.0
        other = replace(samples, value=rng.uniform(200.0, 900.0, len(samples.value)))
        assert held_out(other, camera, estimated) < 1.0


def test_no_overlap_is_refused():
    empty = np.zeros(0, dtype=int)
    with pytest.raises(ValueError, match="no place is shown by two"):
        balance(ToneSamples(empty, empty, np.zeros(0), np.zeros(0), empty), np.zeros(2, dtype=int), np.array([False]))


@pytest.mark.parametrize("places", [200, 20_000])
@pytest.mark.parametrize("low", [1000.0, 900.0])
def test_orthoimages_that_agree_to_the_last_bit(places, low):
    """Water of one grey in two parts of one image: sigmas a priori were lost in rounding, and the matrix singular."""
    value = np.repeat(np.where(np.arange(places) % 2 > 0, low, 1000.0), 2)
    place, layer = np.repeat(np.arange(places), 2), np.tile([0, 1], places)
    samples = ToneSamples(place, layer, value, np.zeros(2 * places), np.zeros(places, dtype=np.int64))
    found = balance(samples, np.array([0, 0]), np.array([False]))
    np.testing.assert_allclose(found.gain, 1.0, atol=1e-9)
    np.testing.assert_allclose(found.offset, 0.0, atol=1e-6)
    one_grey = low == 1000.0  # gain and offset cannot be told apart, but by what is known beforehand
    np.testing.assert_allclose(found.gain_sigma, 0.25 if one_grey else 0.0, atol=1e-3)
