"""The looks at places: each place of the master view is matched in all other views, and gets its height."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .consistency import Disagreement, height_of
from .line_scan import LineScan
from .options import MatchedRay, MatchingOptions, Place
from .prediction import WIDE, Prediction, sample_m
from .search import Found, Ground, Image, find

Array = NDArray[np.floating]


@dataclass(frozen=True)
class Looked:
    """Places that were matched and wait for a verdict; k of them.

    Attributes
    ----------
    places : as they were chosen
    rays : of each, the master's first
    score : (k,) least correlation coefficient
    xyz_l : (k, 3) with the orientation of now
    disagreement : what is left of their shifts
    chip : (k, n, n) what the master saw about them, on the ground; empty where no patches are kept
    ground : the grids of the chips
    """

    places: list[Place]
    rays: list[tuple[MatchedRay, ...]]
    score: Array
    xyz_l: Array
    disagreement: Disagreement
    chip: NDArray[np.floating] = field(repr=False)
    ground: Ground

    def __len__(self) -> int:
        return len(self.places)


class LookMatcher:
    """Matches places in the views.

    Parameters
    ----------
    prediction : of the strip
    image : gives the lines of a view: (index of the view, scan, way from line to line) -> `Image`
    chip_half : half side of the patches that are kept for later strips, px; 0 for none

    Attributes
    ----------
    least_rays : of a point
    """

    def __init__(self, prediction: Prediction, image: Callable[[int, LineScan, float], Image], chip_half: int):
        self.prediction = prediction
        self.counters: Counter[str] = Counter()
        self._image, self._chip_half = image, chip_half
        self.least_rays = min(prediction.options.least_rays, len(prediction.views))

    def match(self, places: list[Place]) -> Looked | None:
        """What was found of places, those with enough looks; None if that is none."""
        p = self.prediction
        line, sample = np.array([[place.line, place.sample] for place in places]).T
        master = p.scan(p.master, line.min() - WIDE, line.max() + WIDE)
        if master is None:
            self.counters["no orientation"] += len(places)
            return None
        _, travel = p.height_and_travel()
        guess_l, _ = master.to_plane(line, sample, np.full(len(line), p.heights.prior_m))
        height, sigma_height = p.heights.at(guess_l[:, :2])
        centre, slope = master.to_plane(line, sample, height)
        ground = p.ground(master, centre)
        time_s = p.first_s + line / p.rate
        across = 2 * sample / p.views[p.master].pixels - 1
        expected = p.slow.expected(time_s, across)

        k, views = len(line), len(p.others)
        shift, parallax = np.full((k, views, 2), np.nan), np.zeros((k, views, 2))
        weight, covariance = np.zeros((k, views)), np.full((k, views, 2, 2), np.inf)
        score, located = np.zeros((k, views)), np.full((k, views, 2), np.nan)
        scale_across, beyond = np.ones(views), 0.0
        for j, index in enumerate(p.others):
            done = self._match_view(index, master, line, ground, expected[:, j], sigma_height, slope, travel)
            if done is None:
                self.counters["no lines"] += k
                continue
            found, scan, other_line, parallax[:, j] = done
            beyond = max(beyond, float((found.reason == "beyond search").mean()))
            good = self._accept(found)
            shift[good, j] = found.shift[good]
            covariance[good, j], score[:, j] = found.covariance[good], found.score
            weight[good, j] = 1.0
            place = ground.moved(np.where(good[:, None], found.shift, 0.0)).centre_l
            u, v, inside = scan.locate(place, other_line + found.shift[:, 0] * ground.spacing_m / travel)
            ok = good & inside & np.isfinite(u)
            located[ok, j] = np.column_stack([u, v])[ok]
            shift[~ok, j] = np.nan
            scale_across[j] = sample_m(scan, place, u)
        p.searched(beyond)
        enough = 1 + np.isfinite(shift).all(axis=2).sum(axis=1) >= self.least_rays
        self.counters["too few looks"] += int((~enough).sum())
        if not enough.any():
            return None
        dz, _ = height_of(shift - expected, parallax, weight)
        # nothing that a height explains may stay in what is expected of the next points: it would never leave it again
        _, residual = height_of(shift, parallax, weight)
        xyz = np.column_stack([centre[:, :2] + slope * dz[:, None], height + dz])
        pixel_m = np.column_stack([np.full(views + 1, travel), [sample_m(master, centre, line), *scale_across]])
        chosen = np.flatnonzero(enough)
        # a place is where a noisy pose sees it: line by attitude about y, sample about x, position for both
        noise = p.orientation.noise_left
        wobble = (noise[:2].mean() + p.height_and_travel()[0] ** 2 * noise[[4, 3]]) / pixel_m**2
        per_px = ground.spacing_m / pixel_m
        rays = [self._rays(places[i], located[i], covariance[i], per_px, wobble) for i in chosen]
        known = np.isfinite(located).all(axis=2)
        chip = np.empty((len(chosen), 0, 0))
        if self._chip_half:
            ground = Ground(xyz[enough], ground.along, ground.across, ground.spacing_m)
            chip = self._image(p.master, master, travel).patches(ground, line[enough], self._chip_half, 1)[0]
        return Looked(
            [places[i] for i in chosen], rays, np.where(known, score, 1.0).min(axis=1)[enough], xyz[enough],
            Disagreement(time_s[enough], across[enough], residual[enough]), chip, ground.select(
                np.arange(len(ground.centre_l)) if self._chip_half else enough
            ),
        )  # fmt: skip

    def _match_view(
        self, index: int, master_scan: LineScan, line: Array, ground: Ground, expected: Array, sigma_height: Array,
        slope: Array, travel: float,
    ) -> tuple[Found, LineScan, Array, Array] | None:  # fmt: skip
        """Matches in one view: what was found, its lines, the predicted line, and the parallax per metre, px."""
        p = self.prediction
        view, m = p.views[index], p.views[p.master]
        above = float(np.median(master_scan.position_l[:, 2])) - ground.centre_l[:, 2]
        away = (m.forward - view.forward) * above / travel
        wide = p.scan(index, (line + away).min() - 2 * WIDE, (line + away).max() + 2 * WIDE)
        if wide is None:
            return None
        moved = ground.moved(expected)
        other_line, _, _ = wide.locate(moved.centre_l, line + away, rounds=5)
        other_line = np.clip(other_line, wide.first_line, wide.first_line + len(wide.position_l) - 1)
        # slope of the other rays, for what height does
        camera = wide.position_l[(other_line - wide.first_line).astype(int)]
        other_slope = (moved.centre_l[:, :2] - camera[:, :2]) / (moved.centre_l[:, 2:] - camera[:, 2:])
        axes = np.stack([ground.along, ground.across]) / ground.spacing_m
        parallax = (slope - other_slope) @ axes.T
        reach = p.reach(index, ground, sigma_height, parallax)
        master = self._image(p.master, master_scan, travel)
        base_line = other_line - expected[:, 0] * ground.spacing_m / travel
        found = find(master, line, ground, self._image(index, wide, travel), expected, base_line, reach)
        return found, wide, base_line, parallax

    def _accept(self, found: Found) -> NDArray[np.bool_]:
        reason = verdict(found, self.prediction.options)
        names, counts = np.unique(reason[reason != ""], return_counts=True)
        self.counters.update(dict(zip(names.tolist(), counts.tolist(), strict=True)))
        return reason == ""

    def _rays(
        self, place: Place, located: Array, covariance: Array, px: Array, wobble: Array
    ) -> tuple[MatchedRay, ...]:
        """Half of a match's variance belongs to each of its two images.

        ``px`` is ground grid to pixels, ``wobble`` the variance by noisy poses, px^2; per view, of line and sample.
        """
        p = self.prediction
        known = np.flatnonzero(np.isfinite(located).all(axis=1))
        half = 0.5 * np.diagonal(covariance[known], axis1=1, axis2=2)
        floor = 0.5 * p.options.image_sigma_px**2
        own = half.mean(axis=0) * px[0] ** 2 + floor if place.variance is None else np.array(place.variance)
        own = own + wobble[0]
        ccd = p.views[p.master].ccd
        rays = [MatchedRay(ccd, place.line, place.sample, float(own[0] ** 0.5), float(own[1] ** 0.5))]
        for j, variance in zip(known, half, strict=True):
            v = np.sqrt(variance * px[1 + j] ** 2 + floor + wobble[1 + j])
            line, sample = located[j]
            ccd = p.views[p.others[j]].ccd
            rays.append(MatchedRay(ccd, float(line), float(sample), float(v[0]), float(v[1])))
        return tuple(rays)


def verdict(found: Found, options: MatchingOptions) -> NDArray[np.str_]:
    """(k,) why a match is not taken, empty for good ones."""
    reason = found.reason.copy()
    sigma = np.sqrt(np.maximum(np.diagonal(found.covariance, axis1=1, axis2=2).max(axis=1), 0.0))
    for name, bad in (
        ("low correlation", found.score < options.least_score),
        ("no way back", ~(found.closing <= options.largest_closing_px)),
        ("imprecise", ~(sigma <= options.largest_sigma_px)),
    ):
        reason[(reason == "") & bad] = name
    return reason
