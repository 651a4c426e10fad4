"""Drifts of tie points in the batches of the window: the equations of many batches at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...adjustment.drift_hypotheses import EACH
from ...adjustment.linearisation import joined_equations
from ...adjustment.network import Rays
from ...adjustment.ray_statistics import whitened_pixels
from ...arrays import IntArray
from ..state.batch import Batch, residuals_px_of
from ..state.unknowns import Border, WindowState
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


def cells_of(drifting: Sequence[Drifting], state: WindowState, strip: int, start_s: float, unit_s: float) -> list[Cell]:
    """Cells of batches whose rays belong to the same groups; what goes ray by ray is computed for all of them at once.

    Parameters
    ----------
    strip : its place
    start_s, unit_s : when the drifts began, and their unit of time
    """
    batches, present = [d.batch for d in drifting], drifting[0].present
    ends = np.cumsum([len(b.rays) for b in batches])
    firsts = np.concatenate([[0], ends[:-1]])
    rays = Rays.joined([b.rays for b in batches])
    lin, whitening = joined_equations([(b.lin, b.whitening) for b in batches])
    n, k = len(rays), EACH * len(present)
    use = np.concatenate([first + d.use for first, d in zip(firsts, drifting, strict=True)])
    pixels = whitened_pixels(rays, lin, whitening)
    since = (rays.time_s - start_s) / unit_s
    effect = np.zeros((n, 2, len(present), 2, 2))  # of a line and a sample, constant and drifting
    moved = np.stack([pixels, pixels * since[:, None, None]], axis=2)[use]
    effect[use, :, np.concatenate([d.of_ray for d in drifting])] = moved
    effect = effect.reshape(n, 2, k)
    v = np.einsum("nij,nj->ni", pixels, np.concatenate(residuals_px_of(batches, state)))
    W = np.concatenate([b.without_points[0] for b in batches])
    of_points = np.concatenate([first + b.first_ray[:-1] for first, b in zip(firsts, batches, strict=True)])
    coupling = np.add.reduceat(np.swapaxes(W, 1, 2) @ effect, of_points, axis=0)
    noise = np.concatenate([b.pose_covariance[d.use, :3, :3] for b, d in zip(batches, drifting, strict=True)])
    of_position = lin.orientation[:, :3].transpose(2, 0, 1)[use]
    variances = 0.5 * np.einsum("nij,njk,nik->n", of_position, noise, of_position)
    places = (EACH * present[:, None] + np.arange(EACH)).ravel()
    cells: list[Cell] = []
    point = used = 0
    for d, low, high in zip(drifting, firsts.tolist(), ends.tolist(), strict=True):
        batch = d.batch
        own = effect[low:high]
        flat = own.reshape(-1, k)
        of_batch = coupling[point : point + batch.n_points]
        through = of_batch.reshape(-1, k)
        G = batch.without_points[1].reshape(len(flat), -1).T @ flat
        score = flat.T @ v[low:high].ravel() + state.values(batch.columns) @ G
        counts = np.zeros(MOST_GROUPS, dtype=np.int64)
        counts[present] = np.bincount(d.of_ray, minlength=len(present))
        shared = float(variances[used : used + len(d.use)].sum())
        border = Border(batch.columns, G, flat.T @ flat - through.T @ through, score)
        cells.append(Cell(batch.information, batch.weight, strip, places, border, counts, shared, own, of_batch))
        point, used = point + batch.n_points, used + len(d.use)
    return cells
