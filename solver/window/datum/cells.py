"""Drifts of tie points in the batches of the window: the equations of many batches at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...adjustment.drift_hypotheses import EACH
from ...adjustment.ray_statistics import pixels_of_motion
from ...arrays import IntArray
from ..state.batch import Batch
from .drifts import MOST_GROUPS, Cell


@dataclass(frozen=True)
class Drifting:
    """Rays of a batch that may drift.

    Attributes
    ----------
    batch : with n rays
    use : (m,) places of these rays
    present : (g,) the groups they belong to, among those of the strip, sorted
    of_ray : (m,) which of these
    """

    batch: Batch
    use: IntArray
    present: IntArray
    of_ray: IntArray


def cells_of(
    drifting: Sequence[Drifting], strip: int, start_s: float, unit_s: float, vibration: float = 0.0
) -> list[Cell]:
    """Cells of batches whose rays belong to the same groups; what goes ray by ray is computed for all of them at once.
    For the equations see `Batch.border`.

    Parameters
    ----------
    strip : its place
    start_s, unit_s : when the drifts began, and their unit of time
    vibration : noise of the attitude from look to look, rad
    """
    batches, present = [d.batch for d in drifting], drifting[0].present
    ends = np.cumsum([len(b.rays) for b in batches])
    firsts = np.concatenate([[0], ends[:-1]])
    use = np.concatenate([first + d.use for first, d in zip(firsts, drifting, strict=True)])
    n, k = int(ends[-1]), EACH * len(present)
    rays = [b.rays for b in batches]
    orientation = np.concatenate([b.lin.orientation for b in batches], axis=2)
    pixels = pixels_of_motion(
        np.concatenate([np.concatenate([r.velocity_l for r in rays]), np.concatenate([r.angle_rate for r in rays])], 1),
        np.concatenate([r.line_period_s for r in rays]),
        np.concatenate([r.pitch_mm for r in rays]),
        orientation,
        np.concatenate([b.whitening.g for b in batches], axis=1),
    )
    since = (np.concatenate([r.time_s for r in rays]) - start_s) / unit_s
    effect = np.zeros((n, 2, len(present), 2, 2))  # of a line and a sample, constant and drifting
    moved = np.stack([pixels, pixels * since[:, None, None]], axis=2)[use]
    effect[use, :, np.concatenate([d.of_ray for d in drifting])] = moved
    effect = effect.reshape(n, 2, k)
    W = np.concatenate([b.through_points for b in batches])
    of_points = np.concatenate([first + b.first_ray[:-1] for first, b in zip(firsts, batches, strict=True)])
    coupling = np.add.reduceat(np.swapaxes(W, 1, 2) @ effect, of_points, axis=0)
    noise = np.concatenate([b.pose_covariance[d.use, :3, :3] for b, d in zip(batches, drifting, strict=True)])
    of_position = orientation[:, :3].transpose(2, 0, 1)[use]
    variances = 0.5 * ((of_position @ noise) * of_position).sum(axis=(1, 2))
    vibrating = 0.5 * vibration**2 * (orientation[:, 3:] ** 2).sum(axis=(0, 1))[use]
    places = (EACH * present[:, None] + np.arange(EACH)).ravel()
    cells: list[Cell] = []
    point = used = 0
    for d, low, high in zip(drifting, firsts.tolist(), ends.tolist(), strict=True):
        batch = d.batch
        own, of_batch = effect[low:high].copy(), coupling[point : point + batch.n_points].copy()
        border = batch.border(own, of_batch)
        counts = np.zeros(MOST_GROUPS, dtype=np.int64)
        counts[present] = np.bincount(d.of_ray, minlength=len(present))
        here = slice(used, used + len(d.use))
        shares = np.array([variances[here].sum(), vibrating[here].sum()])
        cells.append(Cell(batch.information, batch.weight, strip, places, border, counts, shares, own, of_batch))
        point, used = point + batch.n_points, used + len(d.use)
    return cells
