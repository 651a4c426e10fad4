"""A match does not lean to where it was expected, and has the covariance that it states."""

from dataclasses import dataclass

import numpy as np
import pytest

from triline.solver.matching.patches import interpolate_stack
from triline.solver.matching.search import Ground, Patches, find

SIDE, PLACES = 96, 300


@dataclass(frozen=True)
class Flat:
    """Images (k, n, n) whose pixels are those of the ground, from the middle on, but for a part of a pixel (k, 2)."""

    values: np.ndarray
    origin: np.ndarray
    phase: np.ndarray
    line_m: float = 1.0

    def select(self, chosen):
        return Flat(self.values[chosen], self.origin[chosen], self.phase[chosen])

    def patches(self, ground, line, half, factor):
        grid = factor * np.arange(-half, half + 1.0)
        # places are selected by now, this image perhaps not
        mine = [int(np.argmin(np.abs(self.origin - x))) for x in np.rint(ground.centre_l[:, 2])]
        at = ground.centre_l[:, :2] + SIDE // 2 + self.phase[mine]
        y, x = (at[:, i, None, None] + (grid[:, None] if i == 0 else grid) for i in (0, 1))
        y, x = np.broadcast_arrays(y, x)
        k = len(ground.centre_l)
        return Patches(interpolate_stack(self.values[mine], y, x), np.ones(k), np.zeros(k))


def views(noise, cutoff, seed=3):
    """Texture with noise, seen by two views whose pixels lie anywhere; the place is the middle.

    Of the first, lines are interpolated and samples are not, as it is with the master.
    """
    rng = np.random.default_rng(seed)
    f = np.hypot(np.fft.fftfreq(SIDE)[:, None], np.fft.fftfreq(SIDE)[None, :])
    spectrum = np.fft.fft2(rng.standard_normal((PLACES, SIDE, SIDE))) * np.exp(-0.5 * (f / cutoff) ** 2)
    spectrum *= 300.0 / np.fft.ifft2(spectrum).real.std()
    out = []
    for interpolated in ([1.0, 0.0], [1.0, 1.0]):
        phase = rng.uniform(-0.5, 0.5, (PLACES, 2)) * interpolated
        turn = np.fft.fftfreq(SIDE)[:, None] * phase[:, 0, None, None]
        turn = turn + np.fft.fftfreq(SIDE) * phase[:, 1, None, None]
        image = np.fft.ifft2(spectrum * np.exp(-2j * np.pi * turn)).real
        image += noise * rng.standard_normal(image.shape)
        out.append(Flat(image.astype(np.float32), np.arange(PLACES, dtype=float), phase))
    return out


def found_from(master, other, wrong_px):
    """What is found from a prediction that is wrong along and across; the truth is no shift."""
    centre = np.column_stack([np.zeros((PLACES, 2)), np.arange(PLACES, dtype=float)])
    ground = Ground(centre, np.array([1.0, 0.0]), np.array([0.0, 1.0]), 1.0)
    line = np.zeros(PLACES)
    return find(master, line, ground, other, np.full((PLACES, 2), wrong_px), line, 6.0)


@pytest.mark.parametrize("wrong_px", [0.4, 1.3, *(pytest.param(px, marks=pytest.mark.study) for px in (0.25, -0.25))])
def test_a_prediction_wrong_by_a_part_of_a_pixel_does_not_move_the_match(wrong_px):
    here = views(25.0, 0.15)
    right, wrong = (found_from(*here, px) for px in (0.0, wrong_px))
    good = (right.reason == "") & (wrong.reason == "")
    assert good.mean() > 0.95
    assert 0.003 < wrong.shift[good].std() < 0.03
    # the same noise: with one patch, places moved by 0.02 px
    assert np.abs((wrong.shift - right.shift)[good].mean(axis=0)).max() < 0.005


@pytest.mark.parametrize("noise", [20.0, pytest.param(40.0, marks=pytest.mark.study), 60.0])
def test_the_covariance_holds_for_weak_and_strong_noise(noise):
    found = found_from(*views(noise, 0.08), 0.3)
    good = found.reason == ""
    variance = np.diagonal(found.covariance, axis1=1, axis2=2)[good]
    assert good.mean() > 0.95
    assert 0.6 < (found.shift[good] ** 2 / variance).mean() < 1.6
