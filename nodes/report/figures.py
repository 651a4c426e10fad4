"""Figures of a flight: map, residuals per CCD line, progress of the adjustment, correction functions, errors."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ...solver.accuracy import angle_difference
from ...solver.quantiles import chi2, norm
from .. import convert
from .evaluation import corrections_of, orientation_errors
from .flight import Flight, Key, Look, PoseSeries, rejected_key, updates_with_new_rays
from .strip_time import StripTime, shortened
from .style import CCDS, CHECK, CONTROL, FILTERED, FINAL, LIVE, REJECTED, TIE, TRUTH, figure, scale_note

Array = NDArray[np.floating]

COMPONENTS = ("X", "Y", "Z", "omega", "phi", "kappa")
SYMBOLS = ("X", "Y", "Z", "ω", "φ", "κ")
MDEG = 1000.0 * float(np.degrees(1.0))
SCALE = np.array([1.0, 1.0, 1.0, MDEG, MDEG, MDEG])
_TELLING = 30  # redundancy from which sigma0 is shown
_NARROWEST = 0.1  # of the map's length is its width at least, also of a straight flight
_NAME = 12  # letters of a strip on the map
_SAME_PLACE, _MOST_NAMES = 0.01, 3  # strips that begin closer than this share of the map are named together, so many
_MOST_ARROWS = 300  # residuals of a CCD line that are drawn; arrows of more would cover each other
_SIGMAS = 3.0


def trajectory_map(flight: Flight) -> Figure | None:
    """Strips, ground points by status, and adjusted minus given coordinates of control and check points."""
    poses = flight.poses.get(flight.measured) or flight.poses.get("final") or flight.poses.get("truth")
    if poses is None:
        return None
    low, high = poses.position_l.min(axis=0), poses.position_l.max(axis=0)
    points = _point_arrays(flight)
    for drawn in (points["xyz"], np.array([[g.x, g.y, g.z] for g in flight.ground.values()])):
        if len(drawn):
            low, high = np.minimum(low, drawn.min(axis=0)), np.maximum(high, drawn.max(axis=0))
    extent = np.maximum(high - low, 1.0)[:2]
    turned = extent[1] > 1.15 * extent[0]  # north is drawn to the right, to fill the page
    fig = figure(float(np.clip(1.45 + 8.6 * min(extent) / max(extent), 2.3, 7.5)))
    ax = fig.add_subplot()
    ax.set_aspect("equal", anchor="N")

    def place(xyz: Array) -> tuple[Array, Array]:
        e, n = xyz[..., 0] / 1000, xyz[..., 1] / 1000
        return (n, -e) if turned else (e, n)

    step = max(1, len(poses) // 2000)
    ax.plot(*place(poses.position_l[::step]), color=FILTERED, lw=1.0, label="flown")
    _strips(ax, flight, poses, place)
    for status, color, size in (("live", LIVE, 5), ("final", TIE, 5), ("rejected", REJECTED, 16)):
        chosen = points["status"] == status
        if chosen.any():
            label = {"live": "tie, not final", "final": "tie, final", "rejected": "with a rejected ray"}[status]
            marker = "x" if status == "rejected" else "o"
            ax.scatter(*place(points["xyz"][chosen]), s=size, c=color, marker=marker, lw=0.8, label=label, zorder=3)
    _misfits(ax, flight, place, 0.06 * float(max(extent)) / 1000, turned)
    if turned:
        ax.set_xlabel("north [km]")
        ax.set_ylabel("east [km], downwards")
        ax.yaxis.set_major_formatter(lambda value, _: f"{-value + 0.0:g}")
    else:
        ax.set_xlabel("east [km]")
        ax.set_ylabel("north [km]")
    length, (low_y, high_y) = float(np.ptp(ax.get_xlim())), ax.get_ylim()
    if (missing := _NARROWEST * length - (high_y - low_y)) > 0:
        ax.set_ylim(low_y - missing / 2, high_y + missing / 2)
    fig.suptitle("Flight and ground points, local frame", x=0.01, ha="left", fontsize=9.5, fontweight="bold")
    fig.legend(loc="outside lower center", ncols=7)
    FigureCanvasSVG(fig)
    fig.draw_without_rendering()  # the layout of axes with a fixed aspect is right from the second time on
    return fig


def _strips(ax: Axes, flight: Flight, poses: PoseSeries, place: Any) -> None:
    named: list[tuple[Array, list[str]]] = []  # place of a name, and the strips that begin there
    near = _SAME_PLACE * float(np.ptp(poses.position_l[:, :2], axis=0).max()) / 1000
    for k, id in enumerate(flight.strips):
        span = flight.strip_times(id)
        if span is None:
            continue
        inside = np.flatnonzero((poses.time_ns >= span[0]) & (poses.time_ns <= span[1]))
        if len(inside) < 2:
            continue
        inside = inside[:: max(1, len(inside) // 500)]
        x, y = place(poses.position_l[inside])
        ax.plot(x, y, color="#34495e", lw=2.4, solid_capstyle="butt", label="strip" if k == 0 else None)
        ax.annotate("", (x[-1], y[-1]), (x[-2], y[-2]), arrowprops={"arrowstyle": "-|>", "color": "#34495e", "lw": 2})
        begin = np.array([x[0], y[0]])
        there = [ids for at, ids in named if np.hypot(*(at - begin)) <= near]
        if not there:
            named.append((begin, ids := []))
            there = [ids]
        there[0].append(shortened(id, _NAME))
    text = {"xytext": (0, 5), "textcoords": "offset points", "ha": "center", "color": "#34495e", "weight": "bold"}
    above = {"zorder": 7, "bbox": {"color": "white", "alpha": 0.6, "pad": 0.5, "lw": 0}}  # legible among points
    for at, ids in named:
        more = ", …" if len(ids) > _MOST_NAMES else ""
        ax.annotate(", ".join(ids[:_MOST_NAMES]) + more, (float(at[0]), float(at[1])), **text, **above)


def _misfits(ax: Axes, flight: Flight, place: Any, length_km: float, turned: bool) -> None:
    """Control and check points, with planimetric residual vectors and height bars of what is given."""
    rows = []
    for id, g in flight.ground.items():
        adjusted = flight.points.get(id)
        left = np.full(3, np.nan)
        if adjusted is not None:
            left = np.array([adjusted.x, adjusted.y, adjusted.z]) - flight.given(id)
        rows.append((np.array([g.x, g.y, g.z]), left, convert.role_of(g) == "check"))
    if not rows:
        return
    largest = max((float(np.nanmax(np.abs(left))) for _, left, _ in rows if np.isfinite(left).any()), default=0.0)
    scale = length_km / largest if largest > 0 else 0.0
    for check, color, marker, label in ((False, CONTROL, "^", "control"), (True, CHECK, "s", "check")):
        chosen = [(given, left) for given, left, is_check in rows if is_check is check]
        if not chosen:
            continue
        x, y = place(np.array([given for given, _ in chosen]))
        ax.scatter(x, y, s=30, c=color, marker=marker, label=f"{label} ({len(chosen)})", zorder=5, lw=0)
        left = np.array([left for _, left in chosen])
        dx, dy = (left[:, 1], -left[:, 0]) if turned else (left[:, 0], left[:, 1])
        arrows = {"angles": "xy", "scale_units": "xy", "scale": 1, "width": 0.002, "zorder": 6}
        ax.quiver(x, y, scale * dx, scale * dy, color=color, **arrows)
        ax.vlines(x, y, y + scale * left[:, 2], color=color, lw=2.2, alpha=0.45, zorder=4)
    if scale > 0:
        scale_note(ax, f"adjusted − given: arrow planimetry, bar height; largest {largest:.3f} m", "left")


def _point_arrays(flight: Flight) -> dict[str, Any]:
    values = list(flight.points.values())
    bad = {r.point for r in flight.rejected}
    status = np.array([_status(p, p.point in bad) for p in values], dtype="<U8")
    return {"xyz": np.array([[p.x, p.y, p.z] for p in values]).reshape(-1, 3), "status": status}


def _status(point: Any, rejected: bool) -> str:
    if rejected:
        return "rejected"
    return "final" if point.status == point.FINAL else "live"


def residuals_by_ccd(flight: Flight) -> dict[str, Array]:
    """Rays by CCD line: line, sample, v_line, v_sample (px), w, rejected; (n, 6).

    A rejected ray whose point was given up, or was not estimated again, has residual 0.
    """
    rows: dict[str, list[Any]] = {}
    bad = {rejected_key(r) for r in flight.rejected}
    for point in flight.points.values():
        for r in point.residuals:
            if _ray_key(point.point, r) not in bad:
                rows.setdefault(r.ccd, []).append((r.line, r.sample, r.v_line, r.v_sample, r.w, 0.0))
    for r in flight.rejected:
        rows.setdefault(r.ccd, []).append((r.line, r.sample, 0.0, 0.0, r.w, 1.0))
    order = list(flight.ccds) or sorted(rows)
    arrays = {ccd: np.array(rows[ccd], dtype=float) for ccd in order if ccd in rows}
    finite = {ccd: values[np.isfinite(values).all(axis=1)] for ccd, values in arrays.items()}
    return {ccd: values for ccd, values in finite.items() if len(values)}


def _ray_key(point: str, residual: Any) -> Key:
    """The key of `rejected_key` for a residual of a point."""
    r = residual
    return Look(point, r.strip, r.ccd, r.line, r.sample, 0.0, 0.0).key


def residuals(flight: Flight) -> Figure | None:
    """Residual vectors in image space and histograms, a row for each CCD line."""
    by_ccd = residuals_by_ccd(flight)
    if not by_ccd:
        return None
    used = np.concatenate([rows[rows[:, 5] == 0] for rows in by_ccd.values()])
    rms = float(np.sqrt(np.mean(used[:, 2:4] ** 2))) if len(used) else 0.3
    fig = figure(2.35 * len(by_ccd) + 0.3)
    axes = fig.subplots(len(by_ccd), 2, width_ratios=[2.6, 1], squeeze=False, sharex="col")
    longest = max(float(rows[:, 0].max()) for rows in by_ccd.values())
    widest = max(flight.ccds.values(), default=None)
    for k, (ccd, rows) in enumerate(by_ccd.items()):
        _vectors(axes[k, 0], ccd, rows, CCDS[k % len(CCDS)], rms, longest, widest)
        _histogram(axes[k, 1], rows[rows[:, 5] == 0], rms, first=k == 0)
    axes[-1, 0].set_xlabel("sample [px]")
    axes[-1, 1].set_xlabel("residual [px]")
    return fig


def _vectors(ax: Axes, ccd: str, rows: Array, color: str, rms: float, longest: float, widest: int | None) -> None:
    width = float(widest or rows[:, 1].max())
    scale = 0.018 * width / max(rms, 1e-6)  # samples of the plot for a residual of one pixel
    vertical = scale * longest / width * 2.2  # lines of the plot: the axes are about 2.2 times as wide as high
    good, bad = rows[rows[:, 5] == 0], rows[rows[:, 5] > 0]
    shape = {"angles": "xy", "scale_units": "xy", "scale": 1, "headwidth": 3.5, "headlength": 4}
    every = max(1, -(-len(good) // _MOST_ARROWS))
    drawn = good[np.argsort(good[:, 0], kind="stable")][::every]
    ax.quiver(drawn[:, 1], drawn[:, 0], scale * drawn[:, 3], vertical * drawn[:, 2], color=color, width=0.0016, **shape)
    ax.scatter(bad[:, 1], bad[:, 0], marker="x", s=34, c=REJECTED, lw=1.6, zorder=4, clip_on=False)
    ax.set_xlim(0, width)
    ax.set_ylim(0, longest * 1.02)
    ax.set_ylabel("line [px]")
    ax.set_title(
        f"CCD line {ccd}: {len(good)} rays"
        + (f", 1 in {every} drawn" if every > 1 else "")
        + (f"; {len(bad)} rejected (×), all drawn" if len(bad) else "")
    )
    bar = 3 * rms
    ax.plot([width - 0.02 * width - scale * bar, width - 0.02 * width], [longest * 0.97] * 2, color="black", lw=2)
    scale_note(ax, f"bar = {bar:.2g} px")


def _histogram(ax: Axes, rows: Array, rms: float, first: bool) -> None:
    if not len(rows):
        ax.set_axis_off()
        return
    edges = np.linspace(-4 * rms, 4 * rms, 33)
    middle = np.linspace(-4 * rms, 4 * rms, 200)
    for column, label, color in ((2, "along (line)", "#4c78a8"), (3, "across (sample)", "#f2a03d")):
        values = rows[:, column]
        spread = float(np.sqrt(np.mean(values**2)))
        ax.hist(values, edges.tolist(), color=color, alpha=0.55, label=f"{label}, RMS {spread:.2f}")
    density = norm.pdf(middle / rms) / rms * len(rows) * (edges[1] - edges[0])
    ax.plot(middle, density, color="black", lw=1, label="normal" if first else None)
    ax.set_yticks([])
    ax.spines["left"].set_visible(False)
    ax.grid(False)
    ax.set_ylim(0, 1.45 * ax.get_ylim()[1])
    ax.legend(loc="upper left", handlelength=1.2, borderpad=0)


def progress(flight: Flight) -> Figure | None:
    """sigma0, latency and window over time."""
    if not flight.reports:
        return None
    t = flight.seconds(np.array([stamp for stamp, _ in flight.reports]))
    reports = [r for _, r in flight.reports]
    fig = figure(5.0)
    top, middle, bottom = fig.subplots(3, 1, sharex=True, height_ratios=[1.25, 1, 1])
    redundancy = np.array([r.redundancy for r in reports])
    telling = redundancy >= _TELLING  # with a few rays sigma0 says nothing and would set the scale
    sigma0 = np.where(telling, [r.sigma0 for r in reports], np.nan)
    low, high = np.sqrt(chi2.ppf(np.array([[0.025], [0.975]]), np.maximum(redundancy, 1)) / np.maximum(redundancy, 1))
    band = {"color": "#d9e2ef", "label": "95 % band of the redundancy", "lw": 0}
    top.fill_between(t, np.where(telling, low, np.nan), np.where(telling, high, np.nan), **band)
    top.axhline(1.0, color="black", lw=0.8)
    top.plot(t, sigma0, color=FINAL, label="σ₀ of the window")
    total = np.array([r.sigma0_total for r in reports])
    so_far = np.array([r.redundancy_total or r.redundancy for r in reports])  # the window waits after restated sigmas
    total = np.where((so_far >= _TELLING) & (total > 0), total, np.nan)
    if np.isfinite(total).any():
        top.plot(t, total, color=LIVE, label="σ₀ since the start")
    shown = np.concatenate([sigma0, total])
    largest = np.abs(np.clip(shown[np.isfinite(shown)], 0, 3) - 1).max(initial=0.0)
    margin = max(0.15, 1.2 * float(largest))
    top.set_ylim(max(0, 1 - margin), 1 + 1.6 * margin)  # room for the legend
    top.set_title("σ₀ (1 expected)")
    top.legend(loc="upper right", ncols=3)
    new = np.array(updates_with_new_rays(reports))
    data, wall = (np.array([1000 * getattr(r, name) for r in reports]) for name in ("data_latency_s", "compute_s"))
    middle.plot(t, np.where(new, data, np.nan), color=FILTERED, label="newest ray to answer (platform time)")
    if (wall > 0).any():
        middle.plot(t, np.where(new, wall, np.nan), color=LIVE, label="update (wall time)")
    middle.set_ylim(0, 1.35 * middle.get_ylim()[1])
    middle.set_title("Latency of updates with new rays [ms]")
    middle.legend(loc="upper right", ncols=2)
    bottom.plot(t, [r.rays for r in reports], color="#4c78a8", label="rays in the window")
    bottom.plot(t, [r.points for r in reports], color=TIE, label="points in the window")
    bottom.plot(t, [r.rejected_total for r in reports], color=REJECTED, label="rejected since the start")
    bottom.set_ylim(0, 1.35 * bottom.get_ylim()[1])
    bottom.set_title("Window")
    bottom.legend(loc="upper right", ncols=3)
    bottom.set_xlabel("time since the start of the recording [s]")
    return fig


def correction_functions(flight: Flight) -> Figure | None:
    """Corrections of the final orientation with sigma band, the live ones, and the true ones where they are known."""
    final = flight.poses.get("final")
    if final is None:
        return None
    live, truth = flight.poses.get("live"), flight.poses.get("truth")
    fig = figure(5.9)
    axes = fig.subplots(3, 2, sharex=True)
    axis = StripTime(flight)
    t = flight.seconds(final.time_ns)
    values = corrections_of(flight, final) * SCALE
    curves = [("final", t, values, final.strip, FINAL, 1.6)]
    if live is not None:
        of_live = corrections_of(flight, live) * SCALE
        curves.insert(0, ("live", flight.seconds(live.time_ns), of_live, live.strip, LIVE, 0.9))
    if truth is not None and len(truth) >= 2:
        path = truth.trajectory(flight.start_ns)
        known = path.covers(t) & truth.known_at(final.time_ns)
        true = path.at(t[known])
        error = np.hstack(
            [final.position_l[known] - true.position_l, angle_difference(final.angles[known], true.angles)]
        )
        curves.insert(0, ("true", t[known], values[known] - error * SCALE, final.strip[known], TRUTH, 1.0))
    sigma = np.sqrt(np.diagonal(final.covariance, axis1=1, axis2=2)) * SCALE
    for i, ax in enumerate(axes.T.ravel()):
        band = axis.curve(
            t, np.stack([values[:, i] - _SIGMAS * sigma[:, i], values[:, i] + _SIGMAS * sigma[:, i]], axis=1),
            named=final.strip,
        )  # fmt: skip
        ax.fill_between(band[0], band[1][:, 0], band[1][:, 1], color="#bfe3cd", lw=0, label="final ± 3σ")
        for name, time, columns, strip, color, width in curves:
            x, y = axis.curve(time, columns[:, i : i + 1], named=strip)
            style = (0, (4, 2)) if name == "true" else "-"
            ax.plot(x, y[:, 0], color=color, lw=width, ls=style, label=name, zorder=4 if name == "true" else 3)
        ax.axhline(0, color="#777777", lw=0.6)
        ax.set_title(f"d{SYMBOLS[i]} [{'m' if i < 3 else 'mdeg'}]")
    axis.dress(axes.ravel(), axes[-1])
    fig.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return fig


def errors(flight: Flight) -> Figure | None:
    """Errors of the orientation against truth, with the band that the final orientation states."""
    found = {n: e for n, e in orientation_errors(flight).items() if n in (flight.measured, "live", "final")}
    if not found:
        return None
    fig = figure(5.9)
    axes = fig.subplots(3, 2, sharex=True)
    axis = StripTime(flight)
    styles = {flight.measured: (FILTERED, 0.9), "live": (LIVE, 0.9), "final": (FINAL, 1.5)}
    reference = next((name for name in ("final", "live", flight.measured) if name in found), None)
    for i, ax in enumerate(axes.T.ravel()):
        span = 0.0
        if reference is not None:
            time, error, covariance, strip = found[reference]
            sigma = _SIGMAS * SCALE[i] * np.sqrt(covariance[:, i, i])
            x, band = axis.curve(flight.seconds(time), sigma[:, None], named=strip)
            ax.fill_between(x, -band[:, 0], band[:, 0], color="#bfe3cd", lw=0, label=f"± 3σ of {reference}")
            stated = sigma[np.isfinite(sigma)]
            span = max(
                float(np.percentile(stated, 98)) if len(stated) else 0.0, SCALE[i] * float(np.abs(error[:, i]).max())
            )
        for name, (color, width) in styles.items():
            if name in found:
                time, error, _, strip = found[name]
                x, y = axis.curve(flight.seconds(time), SCALE[i] * error[:, i], named=strip)
                ax.plot(x, y, color=color, lw=width, label=name)
                span = max(span, SCALE[i] * float(np.percentile(np.abs(error[:, i]), 90)))
        ax.axhline(0, color="#777777", lw=0.6)
        if span > 0.0:
            ax.set_ylim(-1.15 * span, 1.15 * span)
        ax.set_title(f"{SYMBOLS[i]} error [{'m' if i < 3 else 'mdeg'}]")
    axis.dress(axes.ravel(), axes[-1])
    fig.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return fig
