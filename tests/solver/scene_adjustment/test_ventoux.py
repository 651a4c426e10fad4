"""Real pixels: two Pleiades looks at Mont Ventoux, tie points matched, relative orientation by RPC and affine."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rasterio
from places import DATA, needs_data

from triline.nodes.formats.satellite.read import read_scene
from triline.solver.geometry.ellipsoid import WGS84
from triline.solver.matching.correlation import best_place, correlate
from triline.solver.matching.least_squares import match_patches
from triline.solver.scene_adjustment.block import ImagePoints, KnownGround, SceneBlock
from triline.solver.scene_adjustment.functional import RpcImage
from triline.solver.scene_adjustment.snooping import snoop
from triline.solver.scene_adjustment.solution import adjust, intersect, prepare

#: Side of templates, reach of the search about them, how far points are apart, pixels; the least correlation; height of
#: the ground above the ellipsoid where the images overlap, m.
TEMPLATE, REACH, APART, LEAST, HEIGHT_M = 21, 60, 12, 0.8, 510.0


def cut(image, rows, columns, side):
    """Patches (k, side, side) about rows and columns (k,)."""
    r = np.arange(side) - side // 2
    return image[rows[:, None, None] + r[:, None], columns[:, None, None] + r].astype(float)


def tie_points(folder: Path):
    """Lines and samples (k, 2) in both scenes, and sigmas (k,) of the match."""
    images, first = [], []
    for side in ("left", "right"):
        with rasterio.open(folder / f"{side}_image.tif") as file:
            images.append(file.read(1))
            first.append(np.array([file.transform.f, file.transform.c]))
    rpcs = [read_scene(folder / f"{side}_image.geom").rpc for side in ("left", "right")]
    margin = TEMPLATE // 2 + 1
    grid = np.meshgrid(*(np.arange(margin, n - margin, APART) for n in images[0].shape), indexing="ij")
    left = np.stack([a.ravel() for a in grid], axis=1)
    ground = rpcs[0].direct(*(left + first[0]).T, HEIGHT_M)
    right = np.round(rpcs[1].inverse(*ground.T) - first[1]).astype(int)
    reach, size = TEMPLATE // 2 + REACH, np.array(images[1].shape)
    inside = ((right >= 0) & (right < size)).all(axis=1)
    left, right = left[inside], right[inside]
    padded = np.pad(images[1], reach, mode="reflect")  # so that points near the edge may be searched for
    template = cut(images[0], *left.T, TEMPLATE)
    row, column, score = best_place(correlate(template, cut(padded, *(right + reach).T, TEMPLATE + 2 * REACH)))
    right = right + np.stack([row, column], axis=1) - REACH
    margin += 5
    inside = ((right >= margin) & (right < size - margin)).all(axis=1) & (score > LEAST)
    left, right, template = left[inside], right[inside], template[inside]
    match = match_patches(template, cut(padded, *(right + reach).T, TEMPLATE + 10), np.zeros((len(left), 2)))
    good = match.converged & (match.score > LEAST) & (np.abs(match.shift).max(axis=1) < 2.0)
    sigma = np.sqrt(np.trace(match.covariance, axis1=1, axis2=2) / 2.0)
    return (left + first[0])[good], (right + match.shift + first[1])[good], sigma[good], rpcs


def summary(folder: Path) -> dict[str, float]:
    """Residuals of both images together, root mean square and median, pixels: by RPC, and with a correction."""
    left, right, sigma, rpcs = tie_points(folder)
    n = len(left)
    images = (
        RpcImage("left", rpcs[0], affine=False, shift_sigma_px=1e-3),
        RpcImage("right", rpcs[1], affine=True, shift_sigma_px=50.0, slope_sigma_px=50.0),
    )
    rays = ImagePoints(
        np.repeat([0, 1], n), np.tile(np.arange(n), 2), *np.concatenate([left, right]).T,
        np.tile(np.maximum(sigma, 0.05), 2),
    )  # fmt: skip
    block = SceneBlock(images, tuple(f"P{k}" for k in range(n)), rays, KnownGround.none())
    problem = prepare(block)
    found = snoop(adjust(problem))
    solution = found.solution
    used = solution.ray_weight[:n] & solution.ray_weight[n:]
    # by the RPC alone: intersection with no correction, residuals of both images together
    _, seen = intersect(problem, problem.start, np.ones(2 * n, dtype=bool))
    r = np.concatenate([e.equations(problem.start.position_e, np.zeros(k)).misclosure_px for e, k in
                        zip(problem.rays, (2, 6), strict=True)])  # fmt: skip
    alone = np.linalg.norm(np.hstack([r[:n], r[n:]]), axis=1)[seen & used]
    left_over = np.linalg.norm(np.hstack([solution.residual_px[:n], solution.residual_px[n:]]), axis=1)[used]
    height = WGS84.geodetic(solution.state.position_e[solution.determined])[:, 2]
    return {
        "points": n,
        "left_out": len(found.rays),
        "sigma0": solution.sigma0,
        "rpc_rms": float(np.sqrt(np.mean(alone**2))),
        "rms": float(np.sqrt(np.mean(left_over**2))),
        "median": float(np.median(left_over)),
        "lowest": float(np.percentile(height, 5)),
        "highest": float(np.percentile(height, 95)),
    }


@needs_data
def test_tie_points_of_real_texture_orient_two_looks():
    found = summary(DATA / "satellites" / "phr_ventoux")
    assert found["points"] > 200
    assert found["rms"] < 0.2 and found["rpc_rms"] > 2.0
    assert found["left_out"] < 0.1 * found["points"]
    assert 450.0 < found["lowest"] < found["highest"] < 620.0  # as the SRTM has it
