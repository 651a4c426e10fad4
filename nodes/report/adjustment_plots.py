"""Pictures of a batch adjustment: residuals per CCD line, check and control vectors, correction functions over time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray

from ..batch.adjustment_result import PLOTS, Adjustment, set_name
from ..batch.adjustment_tables import correction_functions
from ..formats.new_file import new_file

matplotlib.use("Agg")
from matplotlib import pyplot as plt

Array = NDArray[np.floating]

#: Image points drawn at most in a frame; arrows of more would cover each other.
MOST_ARROWS = 150

#: Frames side by side at most.
MOST_COLUMNS = 4

#: Of curves in the same colour.
_STYLES: Any = ("-", (0, (5, 1.5)), (0, (1.2, 1)), (0, (5, 1, 1, 1)))
_BLUE, _RED, _GREY, _GREEN = "#2b5d8a", "#c0392b", "#9aa5b1", "#3a7d44"


def write_plots(adjustment: Adjustment, folder: Path) -> list[Path]:
    """Write ``residuals.png``, ``points.png`` and ``corrections.png``; returns their paths."""
    style: Any = {"font.size": 9, "axes.grid": True, "grid.alpha": 0.25, "axes.axisbelow": True, "figure.dpi": 110}
    paths = []
    with plt.rc_context(style):
        for name, draw in zip(PLOTS, (draw_residuals, draw_points, draw_corrections), strict=True):
            figure = draw(adjustment)
            path = folder / name
            with new_file(path) as part:
                figure.savefig(part, format=path.suffix[1:])
            plt.close(figure)
            paths.append(path)
    return paths


def draw_residuals(adjustment: Adjustment) -> Any:
    """Residual vectors of every CCD line over the strip, in pixels; rejected image points are crosses. A strip begins a
    row, and has as many as its CCD lines need."""
    result = adjustment.result
    network, rays, s = result.network, result.network.rays, result.rays
    out = np.zeros(len(rays), dtype=bool)
    out[[r.ray for r in result.rejected if r.ray >= 0]] = True
    ccds = [np.unique(rays.ccd[rays.strip == i]) for i in range(len(network.strips))]
    most = max(map(len, ccds))
    columns = -(-most // -(-most // MOST_COLUMNS))
    panels = [(i, seen[k : k + columns]) for i, seen in enumerate(ccds) for k in range(0, len(seen), columns)]
    height = 0.9 + 1.9 * len(panels)
    figure, axes = plt.subplots(len(panels), columns, figsize=(1.5 + 4.2 * columns, height), squeeze=False)
    rms = float(np.sqrt(np.mean(s.v_px[~out] ** 2))) or 1.0
    for a, (i, lines) in enumerate(panels):
        for axis in axes[a, len(lines) :]:
            axis.set_axis_off()
        first, reach = float(rays.line[rays.strip == i].min()), float(np.ptp(rays.line[rays.strip == i])) or 1.0
        for b, k in enumerate(lines):
            axis = axes[a, b]
            mine = np.flatnonzero((rays.strip == i) & (rays.ccd == k))
            used = mine[~out[mine]]
            used = used[np.argsort(rays.line[used], kind="stable")]
            every = max(1, -(-len(used) // MOST_ARROWS))
            drawn = used[::every]
            pixels = network.camera.lines[k].pixels
            # both components in the same scale: an arrow of one rms is 1/25 of the picture's width
            axis.quiver(
                rays.line[drawn], rays.sample[drawn], s.v_px[drawn, 0], s.v_px[drawn, 1], color=_BLUE, width=0.003,
                scale=25 * rms, scale_units="width", angles="uv",
            )  # fmt: skip
            bad = mine[out[mine]]
            axis.plot(rays.line[bad], rays.sample[bad], "x", color=_RED, markersize=5)
            axis.set_xlim(first - 0.03 * reach, first + 1.03 * reach)
            axis.set_ylim(-0.03 * pixels, 1.03 * pixels)
            rms_here = np.sqrt(np.mean(s.v_px[used] ** 2, axis=0)) if len(used) else np.full(2, np.nan)
            name = f"strip {network.strips[i].id}, {network.camera.lines[k].id}"
            thinned = f"; 1 in {every} of {len(used)}" if every > 1 else f"; {len(used)}"
            axis.set_title(f"{name}: rms {rms_here[0]:.2f}, {rms_here[1]:.2f} px{thinned}", fontsize=9)
            if a == len(panels) - 1 or b >= len(panels[a + 1][1]):
                axis.set_xlabel("line")
            if b == 0:
                axis.set_ylabel("sample")
    figure.suptitle(
        f"Residuals of line and sample; an arrow of 1/25 of a frame is {rms:.2f} px; {int(out.sum())} rejected (x)",
        y=1.0 - 0.06 / height, fontsize="large" if columns > 1 else "small",
    )  # fmt: skip
    figure.tight_layout()
    return figure


def draw_points(adjustment: Adjustment) -> Any:
    """Differences at check and control points, adjusted minus given: planimetry as arrows, height as bars."""
    result = adjustment.result
    network, points = result.network, result.adjusted_points()
    figure, axis = plt.subplots(figsize=(9, 7.5))
    axis.plot(*network.approximate_l[:, :2].T, ".", color=_GREY, markersize=2.5, label="object points")
    kept = {"check": network.check, "control": result.kept_control}
    sets = (("check", network.check, _RED, "o"), ("control", network.control, _GREEN, "^"))
    differences = []
    for _, given, _, _ in sets:
        d = np.where(np.isfinite(given.sigma_m), points[given.point] - given.xyz_l, np.nan)
        differences.append(d)
    together = np.concatenate(differences)
    finite = together[np.isfinite(together)]
    largest = float(np.abs(finite).max()) if len(finite) else 1.0
    scale = 0.1 * float(np.ptp(network.approximate_l[:, :2], axis=0).max()) / max(largest, 1e-9)
    for (name, given, colour, marker), d in zip(sets, differences, strict=True):
        if not len(given):
            continue
        at = np.where(np.isfinite(given.xyz_l), given.xyz_l, points[given.point])
        rms = result.compare(kept[name], points, result.point_sigma_m).rmse_m  # as the table of results has it
        label = f"{name} ({len(given)}): RMS {rms[0]:.3f}, {rms[1]:.3f}, {rms[2]:.3f} m"
        axis.plot(at[:, 0], at[:, 1], marker, color=colour, markersize=5, label=label)
        flat = np.nan_to_num(d[:, :2]) * scale
        axis.quiver(
            at[:, 0],
            at[:, 1],
            flat[:, 0],
            flat[:, 1],
            color=colour,
            angles="xy",
            scale_units="xy",
            scale=1,
            width=0.0025,
        )
        height = np.nan_to_num(d[:, 2]) * scale
        axis.vlines(at[:, 0], at[:, 1], at[:, 1] + height, color=colour, linewidth=2.2, alpha=0.45)
    axis.set_aspect("equal", adjustable="datalim")
    axis.set_xlabel("X, m (local)")
    axis.set_ylabel("Y, m (local)")
    axis.set_title(
        f"Adjusted minus given, enlarged {scale:.0f} times (largest {largest:.3f} m); arrows: X, Y; broad bars: Z"
    )
    axis.legend(loc="upper right", fontsize=8)
    figure.tight_layout()
    return figure


def draw_corrections(adjustment: Adjustment) -> Any:
    """Correction functions of every strip over time with their one-sigma band."""
    layout = adjustment.result.solution.layout
    names = ("dX, m", "dY, m", "dZ, m", "domega, mdeg", "dphi, mdeg", "dkappa, mdeg")
    unit = np.array([1.0] * 3 + [1e3 * 180 / np.pi] * 3)
    names_of_sets = [set_name(adjustment, item) for item in layout.sets]
    columns = max(1, 170 // (max(map(len, names_of_sets)) + 6))
    rows = -(-len(names_of_sets) // columns) if len(names_of_sets) > 1 else 0
    figure, axes = plt.subplots(2, 3, figsize=(13, 6.5 + 0.17 * rows), sharex=True, layout="constrained")
    colours = plt.get_cmap("tab10")
    for n, item in enumerate(layout.sets):
        extent = item.model.extent
        time = np.linspace(extent.start_s, extent.end_s, 400)
        value, covariance = correction_functions(adjustment, item, time)
        value, sigma = value * unit, np.sqrt(np.maximum(np.einsum("nii->ni", covariance), 0.0)) * unit
        share = time - extent.start_s
        for c, axis in enumerate(axes.ravel()):
            colour = colours(n % 10)
            drawn = {"color": colour, "linestyle": _STYLES[n // 10 % len(_STYLES)], "linewidth": 1.3}
            axis.plot(share, value[:, c], label=names_of_sets[n], **drawn)
            axis.fill_between(
                share, value[:, c] - sigma[:, c], value[:, c] + sigma[:, c], color=colour, alpha=0.18, linewidth=0
            )
    for c, axis in enumerate(axes.ravel()):
        axis.axhline(0.0, color="black", linewidth=0.6)
        axis.set_ylabel(names[c])
        if c >= 3:
            axis.set_xlabel("time from the start of the strip, s")
    if rows:
        handles = axes[0, 0].get_legend_handles_labels()
        figure.legend(*handles, loc="outside lower center", ncols=columns, fontsize=8, title="strip")
    figure.suptitle("Corrections of the measured orientation, with one sigma")
    return figure
