"""A canvas of Rerun, and the arrangement of its views. The only file that knows Rerun."""

from __future__ import annotations

import errno
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from ..errors import UserError
from .canvas import Canvas, Color, FleetLayout, NullCanvas, Series, ViewLayout
from .rerun_process import ViewerProcess

Array = NDArray[np.floating]

APPLICATION = "triline"
TIMELINE = "flight_time"
_FLUSH_S = 5.0
_BACKGROUND = [18, 20, 26]  # the colours of the scene are made for a dark ground, whatever the theme
_NAME = [240, 243, 248]  # of labels, whose ground goes with the theme: grey or nearly black
_FIELD_OF_VIEW = np.radians(55.0)  # of the viewer, vertical
_ALWAYS = rrb.TimeRangeBoundary.infinite()  # plots show the whole flight, not what is near the time cursor
_ASPECT, _WIDE_ASPECT = 1.35, 2.0  # of the 3D view, about; wide above curves
_MOSAIC_ASPECT = 3.6  # of one orthoimage above the other
_MARGIN = 1.06
_WINDOW = ("window", "window_upper", "window_lower")  # curves of the window's part of a correction function
_OVERVIEW = ("dX_window", "dY_window", "dZ_window")
_LEGEND_ROOM, _LONGEST_S = 1.3, 300.0
_MAP_POINTS = 300.0  # height and width of the map, about
_TAB_ROOM, _SIDE_ROOM, _LINES_ROOM = (1380.0, 790.0), (640.0, 420.0), (690.0, 650.0)  # for views of CCD lines, points
_TITLE_POINTS = 22.0  # height of a view's title
_MOST_ROWS = 3.5  # of image-space views beside the curves: more rows are lower


class RerunCanvas:
    """Draws into a Rerun recording stream; `process` is the viewer it belongs to, if we started one, `file` where it is
    written to, if it is."""

    def __init__(
        self, stream: rr.RecordingStream, process: ViewerProcess | None = None, file: Path | None = None
    ) -> None:
        self.stream = stream
        self.process = process
        self.file = file
        self._named: set[str] = set()
        stream.log("flight", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def at(self, time_s: float) -> None:
        self.stream.set_time(TIMELINE, duration=time_s)

    def points(
        self, entity: str, xyz: Array, colors: Sequence[Color], radius: float, labels: Sequence[str] | None = None
    ) -> None:
        kind = rr.Points3D if xyz.shape[1] == 3 else rr.Points2D
        self.stream.log(entity, kind(xyz, colors=list(colors), radii=rr.Radius.ui_points(radius)))
        self._names(entity, xyz, labels)

    def lines(
        self, entity: str, strips: Sequence[Array], colors: Sequence[Color], radius: float,
        labels: Sequence[str] | None = None,
    ) -> None:  # fmt: skip
        kind = rr.LineStrips3D if not len(strips) or strips[0].shape[1] == 3 else rr.LineStrips2D
        size = rr.Radius.ui_points(radius)
        self.stream.log(entity, kind(list(strips), colors=list(colors), radii=size))
        self._names(entity, np.array([strip.mean(axis=0) for strip in strips]), labels)

    def _names(self, entity: str, places: Array, labels: Sequence[str] | None) -> None:
        """Labels at places; as an entity of their own, in a colour that can be read on any ground."""
        if labels is None and entity not in self._named:
            return
        self._named.add(entity)
        if not labels:
            self.stream.log(f"{entity}/names", rr.Clear(recursive=False))
            return
        kind = rr.Points3D if places.shape[1] == 3 else rr.Points2D
        radius = rr.Radius.ui_points(0.0)
        names = kind(places, colors=[_NAME], radii=radius, labels=list(labels), show_labels=True)
        self.stream.log(f"{entity}/names", names)

    def arrows(
        self, entity: str, origins: Array, vectors: Array, colors: Sequence[Color], radius: float,
        labels: Sequence[str] | None = None,
    ) -> None:  # fmt: skip
        kind = rr.Arrows3D if origins.shape[1] == 3 else rr.Arrows2D
        size = rr.Radius.ui_points(radius)
        self.stream.log(entity, kind(origins=origins, vectors=vectors, colors=list(colors), radii=size, labels=labels))

    def ellipsoids(self, entity: str, centres: Array, half_axes: Array, quaternions: Array, color: Color) -> None:
        shape = rr.Ellipsoids3D(
            centers=centres, half_sizes=half_axes, quaternions=quaternions, colors=[color],
            line_radii=rr.Radius.ui_points(0.4), fill_mode=rr.components.FillMode.MajorWireframe,
        )  # fmt: skip
        self.stream.log(entity, shape)

    def picture(self, entity: str, corners: Array, grey: NDArray[np.uint8]) -> None:
        mesh = rr.Mesh3D(
            vertex_positions=corners, triangle_indices=[[0, 1, 2], [0, 2, 3]],
            vertex_texcoords=[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]],
            albedo_texture=np.repeat(grey[:, :, None], 3, axis=2),
        )  # fmt: skip
        self.stream.log(entity, mesh)

    def image(self, entity: str, grey: NDArray[np.uint8], place: tuple[float, float], order: float) -> None:
        self.move(entity, place)
        self.stream.log(entity, rr.Image(np.ascontiguousarray(grey), color_model="L", draw_order=order))

    def move(self, entity: str, place: tuple[float, float]) -> None:
        self.stream.log(entity, rr.Transform3D(translation=[*place, 0.0]))

    def geographic_line(self, entity: str, lat_lon: Array, color: Color) -> None:
        self.stream.log(entity, rr.GeoLineStrings(lat_lon=[lat_lon], colors=[color], radii=rr.Radius.ui_points(2.0)))

    def geographic_points(self, entity: str, lat_lon: Array, colors: Sequence[Color], radius: float) -> None:
        self.stream.log(entity, rr.GeoPoints(lat_lon=lat_lon, colors=list(colors), radii=rr.Radius.ui_points(radius)))

    def style(self, entity: str, series: Series) -> None:
        look = rr.SeriesLines(colors=[series.color], names=[series.name], widths=[series.width])
        self.stream.log(entity, look, static=True)

    def curve(self, entity: str, time_s: Sequence[float], values: Sequence[float]) -> None:
        self.stream.send_columns(
            entity, [rr.TimeColumn(TIMELINE, duration=list(time_s))], rr.Scalars.columns(scalars=list(values))
        )

    def event(self, entity: str, text: str, level: str) -> None:
        self.stream.log(entity, rr.TextLog(text, level=level))

    def document(self, entity: str, markdown: str) -> None:
        self.stream.log(entity, rr.TextDocument(markdown, media_type=rr.MediaType.MARKDOWN), static=True)

    def clear(self, entity: str) -> None:
        self.stream.log(entity, rr.Clear(recursive=True))

    def layout(self, layout: ViewLayout | FleetLayout) -> None:
        made = fleet_blueprint(layout) if isinstance(layout, FleetLayout) else blueprint(layout)
        self.stream.send_blueprint(made)

    def close(self) -> None:
        """Write what still waits, however slow a viewer takes it; one that a user has closed takes nothing more.

        Raises
        ------
        OSError : the file cannot be written
        UserError : the viewer ended because it could not go on
        """
        try:
            while not self._flushed():
                pass
        finally:
            self.stream.disconnect()

    def _flushed(self) -> bool:
        """Whether nothing waits any more, after some seconds."""
        try:
            self.stream.flush(timeout_sec=_FLUSH_S)
        except RuntimeError:  # the library does not say why
            if self.file is not None:
                raise _given_up(self.file) from None
            if self.process is None:
                raise
            if self.process.running:
                return False
            self.process.refuse_failure()
        return True


def _given_up(file: Path) -> OSError:
    return OSError(errno.EIO, "its writer has given up, as on a full disk", str(file))


def open_canvas(mode: str) -> Canvas:
    """A canvas by mode: ``native`` (a window), ``web`` (on the loopback interface), ``rrd:PATH`` (a file) or ``none``.

    Raises
    ------
    OSError, UserError : the viewer cannot be started, or the file cannot be written
    ValueError : an unknown mode
    """
    if mode == "none":
        return NullCanvas()
    if mode not in ("native", "web") and not (mode.startswith("rrd:") and len(mode) > 4):
        raise ValueError(f"viewer mode {mode!r}, wanted native, web, rrd:PATH or none")
    stream = rr.RecordingStream(APPLICATION)
    if mode.startswith("rrd:"):
        path = Path(mode[4:])
        if not path.parent.is_dir() or not os.access(path.parent, os.W_OK):
            raise UserError(f"{path}: cannot be written there")
        try:
            stream.save(path)
        except RuntimeError:  # the library does not say why
            raise _given_up(path) from None
        return RerunCanvas(stream, file=path)
    process = ViewerProcess(web=mode == "web")
    stream.connect_grpc(process.grpc_url)
    return RerunCanvas(stream, process)


def blueprint(layout: ViewLayout) -> rrb.Blueprint:
    """Arrangement of the views: an overview, and tabs with what one looks at more closely."""
    if not layout.adjusted:
        return _arranged(_navigation(layout))
    tabs = [_overview(layout), *([_residuals(layout)] if layout.lines else [])]
    tabs += [*([_mosaic(layout)] if layout.mosaic else []), _corrections(layout), _adjustment(layout)]
    tabs += [_parameters(layout)] if layout.units else []
    return _arranged(rrb.Tabs(*tabs, active_tab=0))


def fleet_blueprint(layout: FleetLayout) -> rrb.Blueprint:
    """Arrangement of the views of a fleet: all aircraft in 3D and on the map, their lights, curves, events."""
    low, high = layout.corners.min(axis=0), layout.corners.max(axis=0)
    middle, reach = (low + high) / 2, float(np.linalg.norm((high - low)[:2]))
    distance = 1.25 * max(reach, 200.0) / (2 * np.tan(_FIELD_OF_VIEW / 2))
    eye = middle + distance * np.array([0.0, -0.75, 0.75])
    flight = rrb.Spatial3DView(
        origin="/",
        contents=["+ /flight/**", "+ /points/**", "+ /mosaic/**"],
        name="Thick: final; thin: live; dots: light",
        background=_BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital, position=eye, look_target=middle, eye_up=[0.0, 0.0, 1.0]
        ),
    )
    lights = rrb.Spatial2DView(
        origin="/lights",
        name="Lights",
        background=_BACKGROUND,
        visual_bounds=rrb.VisualBounds2D(
            x_range=[-30.0, 60.0], y_range=[-layout.row, layout.row * max(len(layout.aircraft), 2)]
        ),
    )
    side: list[rrb.View] = [
        rrb.TextDocumentView(origin="/about", name="Why"),
        rrb.TextLogView(origin="/log", name="Events"),
    ]
    if layout.geographic_centre is not None:
        girth = 40_075_017.0 * np.cos(np.radians(layout.geographic_centre[0]))
        zoom = float(np.log2(girth * _MAP_POINTS / 256 / max(reach, 100.0)))
        side.append(rrb.MapView(origin="/map", name="Map", zoom=zoom))
    plots = [_plot("fleet/sigma", "Sigma of the position, worst axis [m]"), _plot("fleet/sigma0", "sigma0")]
    left = rrb.Vertical(flight, rrb.Horizontal(*plots), row_shares=[2.2, 1])
    right = rrb.Vertical(lights, *side, row_shares=[1.0, *[1.0] * len(side)])
    return _arranged(rrb.Horizontal(left, right, column_shares=[2.4, 1]))


def _arranged(views: rrb.Container) -> rrb.Blueprint:
    return rrb.Blueprint(
        views,
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TopPanel(state="collapsed"),
        auto_views=False,
        auto_layout=False,
    )


def _navigation(layout: ViewLayout) -> rrb.Container:
    """Where nothing is adjusted: the trajectory, where it is on the map, and events."""
    log = rrb.TextLogView(origin="/log", name="Events")
    about = rrb.TextDocumentView(origin="/about", name="About this view")
    side = [rrb.Tabs(log, about, active_tab=0), *([_map(layout)] if layout.geographic_centre is not None else [])]
    return rrb.Horizontal(_flight(layout), rrb.Vertical(*side), column_shares=[1.6, 1])


def _overview(layout: ViewLayout) -> rrb.Container:
    side = rrb.Tabs(
        rrb.TextLogView(origin="/log", name="Events"),
        rrb.TextDocumentView(origin="/about", name="About this view"),
        *([_map(layout)] if layout.geographic_centre is not None else []),
        active_tab=0,
    )
    back = _back_s(layout)
    curves = rrb.Grid(
        _plot("sigma0", "sigma0 and its 95 % band", layout.sigma0, legend=False),
        _plot("latency", "Latency [ms]"),
        _plot(
            "overview/position",
            "dX, dY, dZ [m]: final, thin in the window",
            window=_window(layout, _OVERVIEW),
            back_s=back,
        ),
        _plot("overview/integrity", "Protection level and sigma, worst axis [m]", back_s=back),
        grid_columns=2,
    )
    if layout.lines:
        columns = columns_of(len(layout.lines), layout.lines_size, _LINES_ROOM)
        lines = rrb.Grid(*(_lines(ccd, layout) for ccd in layout.lines), grid_columns=columns)
        left = rrb.Vertical(_light(), _flight(layout), _legend(layout), curves, row_shares=[2.5, 10, 1.5, 7.6])
        right = rrb.Vertical(lines, side, row_shares=[10, 2.2])
        return rrb.Horizontal(left, right, column_shares=[1, 1], name="Overview")
    left = rrb.Vertical(_light(), _flight(layout), _legend(layout), side, row_shares=[1.9, 10, 1.3, 2.6])
    columns = columns_of(len(layout.ccds), layout.image_size, _SIDE_ROOM)
    rows = min(-(-len(layout.ccds) // columns), _MOST_ROWS)
    right = rrb.Vertical(_images(layout, columns), curves, row_shares=[rows, 2.7])
    return rrb.Horizontal(left, right, column_shares=[1.15, 1], name="Overview")


def _mosaic(layout: ViewLayout) -> rrb.Container:
    """Both orthoimages from above, the one over the other for a long strip that runs east."""
    low, high = layout.corners.min(axis=0), layout.corners.max(axis=0)
    middle, extent = (low + high) / 2, high - low
    wide = extent[0] >= extent[1]
    reach = max(extent[0] / (_MOSAIC_ASPECT if wide else _MOSAIC_ASPECT / 4), extent[1])
    views = [
        rrb.Spatial3DView(
            origin="/",
            contents=[f"+ /mosaic/{version}/**"],
            name=title,
            background=_BACKGROUND,
            line_grid=rrb.LineGrid3D(visible=False),
            eye_controls=rrb.EyeControls3D(
                kind=rrb.Eye3DKind.Orbital,
                position=[middle[0], middle[1] - 1e-3 * reach, low[2] + reach / (2 * np.tan(_FIELD_OF_VIEW / 2))],
                look_target=[middle[0], middle[1], low[2]],
                eye_up=[0.0, 1.0, 0.0],
            ),
        )
        for version, title in (("live", "Orthoimage, live orientation"), ("final", "Orthoimage, final orientation"))
    ]
    return (rrb.Vertical if wide else rrb.Horizontal)(*views, name="Orthoimage")


def _residuals(layout: ViewLayout) -> rrb.Container:
    return rrb.Vertical(_images(layout, columns_of(len(layout.ccds), layout.image_size, _TAB_ROOM)), name="Residuals")


def _images(layout: ViewLayout, columns: int) -> rrb.Container:
    """Image-space views of all CCD lines."""
    return rrb.Grid(*(_image(ccd, title, layout) for ccd, title in layout.ccds.items()), grid_columns=columns)


def columns_of(views: int, size: tuple[float, float], room: tuple[float, float]) -> int:
    """In how many columns views of one size (width, height; any unit) are shown largest in a room (screen points)."""

    def scale(columns: int) -> float:
        height = room[1] / -(-views // columns) - _TITLE_POINTS
        return min(room[0] / columns / size[0], height / size[1])

    return max(range(1, views + 1), key=scale, default=1)


def _lines(ccd: str, layout: ViewLayout) -> rrb.View:
    width, height = layout.lines_size
    return rrb.Spatial2DView(
        origin=f"/lines/{ccd}",
        name=f"{ccd}: newest line on top",
        background=_BACKGROUND,
        visual_bounds=rrb.VisualBounds2D(x_range=[0.0, width], y_range=[0.0, height]),
    )


def _corrections(layout: ViewLayout) -> rrb.Container:
    units = {"dX": "m", "dY": "m", "dZ": "m", "domega": "mdeg", "dphi": "mdeg", "dkappa": "mdeg"}
    window, back = _window(layout, _WINDOW), _back_s(layout)
    views = [
        _plot(f"corrections/{name}", f"{name} [{unit}]", window=window, back_s=back) for name, unit in units.items()
    ]
    return rrb.Grid(*views, grid_columns=2, name="Correction functions")


def _adjustment(layout: ViewLayout) -> rrb.Container:
    views = [
        _plot("window", "Window: rays, points, rejected"),
        _plot("integrity/position", "Protection level and sigma of the position [m]"),
        _plot("integrity/attitude", "Protection level and sigma of the attitude [mdeg]"),
    ]
    if layout.truth:
        views += [
            _plot("errors/position", "Position error against truth [m]"),
            _plot("errors/attitude", "Attitude error against truth [mdeg]"),
        ]
    return rrb.Grid(*views, grid_columns=2, name="Adjustment")


def _parameters(layout: ViewLayout) -> rrb.Container:
    """Errors of strip, platform and camera as they are estimated, by their units."""
    views = [_plot(f"parameters/{unit}", f"Parameters [{unit}]") for unit in layout.units]
    return rrb.Grid(*views, grid_columns=2, name="Parameters")


def viewpoint(layout: ViewLayout) -> tuple[Array, Array]:
    """Eye and target of the 3D view: from the right of the flight, as near as all corners stay in view.

    The default eye of the viewer does not find a strip kilometres long; this one is computed from what is planned.
    """
    along = layout.along / max(float(np.linalg.norm(layout.along)), 1e-9)
    right = np.array([along[1], -along[0], 0.0])
    backward = 0.86 * right - 0.2 * along + np.array([0.0, 0.0, 0.42])
    backward /= np.linalg.norm(backward)
    across = np.cross([0.0, 0.0, 1.0], backward)
    across /= np.linalg.norm(across)
    up = np.cross(backward, across)
    target = (layout.corners.min(axis=0) + layout.corners.max(axis=0)) / 2
    half = np.tan(_FIELD_OF_VIEW / 2)
    aspect = _WIDE_ASPECT if layout.lines else _ASPECT
    distance = 1.0
    for _ in range(5):  # nearest distance, then move the target so that the picture is centred, and again
        offset = layout.corners - target
        depth = offset @ backward
        reach = np.maximum(np.abs(offset @ across) / (half * aspect), np.abs(offset @ up) / half)
        distance = _MARGIN * float((depth + reach).max())
        x = (offset @ across) / (distance - depth)
        y = (offset @ up) / (distance - depth)
        target = target + distance * ((x.min() + x.max()) / 2 * across + (y.min() + y.max()) / 2 * up)
    return target + distance * backward, target


def _flight(layout: ViewLayout) -> rrb.View:
    eye, target = viewpoint(layout)
    return rrb.Spatial3DView(
        origin="/",
        contents=["+ /flight/**", "+ /points/**", "+ /mosaic/**"],
        name=layout.title,
        background=_BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=True, spacing=layout.grid_m, color=[70, 75, 90, 120], stroke_width=0.6),
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital, position=eye, look_target=target, eye_up=[0.0, 0.0, 1.0]
        ),
    )


def _light() -> rrb.View:
    return rrb.Spatial2DView(
        origin="/light",
        name="Light",
        titlebar=False,
        background=_BACKGROUND,
        visual_bounds=rrb.VisualBounds2D(x_range=[-300.0, 300.0], y_range=[-34.0, 46.0]),
    )


def _legend(layout: ViewLayout) -> rrb.View:
    width = 100.0 * (8 if layout.truth else 7)
    return rrb.Spatial2DView(
        origin="/legend",
        name="Legend",
        titlebar=False,
        background=_BACKGROUND,
        visual_bounds=rrb.VisualBounds2D(x_range=[-60.0, width + 60.0], y_range=[-8.0, 28.0]),
    )


def _image(ccd: str, title: str, layout: ViewLayout) -> rrb.View:
    width, height = layout.image_size
    return rrb.Spatial2DView(
        origin=f"/image/{ccd}",
        name=title,
        background=_BACKGROUND,
        visual_bounds=rrb.VisualBounds2D(x_range=[-0.08 * width, 1.02 * width], y_range=[-0.1 * height, 1.1 * height]),
    )


def _back_s(layout: ViewLayout) -> float:
    """How far back plots of the present strip reach: all of it, and room for the legend; of a long one the end."""
    return _LEGEND_ROOM * min(layout.strip_s, _LONGEST_S)


def _since(seconds: float) -> tuple[rrb.TimeRangeBoundary, rrb.TimeRangeBoundary]:
    """From so long before the time cursor up to the cursor."""
    cursor = rrb.TimeRangeBoundary.cursor_relative
    return cursor(seconds=-seconds), cursor(seconds=0.0)


def _window(layout: ViewLayout, entities: tuple[str, ...]) -> dict[str, Any]:
    """Curves of a plot of which only what the window holds is shown."""
    if layout.window_s is None:
        return {}
    start, end = _since(layout.window_s)
    return {n: rrb.VisibleTimeRanges([rrb.VisibleTimeRange(TIMELINE, start=start, end=end)]) for n in entities}


def _plot(
    entity: str, title: str, span: tuple[float, float] | None = None, legend: bool = True,
    window: dict[str, Any] | None = None, back_s: float | None = None,
) -> rrb.View:  # fmt: skip
    """A plot of the whole flight, or of the time before the cursor; the axes fit what is shown."""
    start, end = (_ALWAYS, _ALWAYS) if back_s is None else _since(back_s)
    return rrb.TimeSeriesView(
        origin=f"/plots/{entity}",
        name=title,
        overrides={f"/plots/{entity}/{name}": ranges for name, ranges in (window or {}).items()},
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop, visible=legend),
        background=rrb.archetypes.PlotBackground(color=_BACKGROUND, show_grid=True),
        axis_x=rrb.TimeAxis(view_range=rrb.TimeRange(start=start, end=end)),
        axis_y=None if span is None else rrb.ScalarAxis(range=span),
        time_ranges=[rrb.VisibleTimeRange(TIMELINE, start=start, end=end)],
    )


def _map(layout: ViewLayout) -> rrb.View:
    """The map, zoomed so that the strips fit: a tile of 256 points shows the Earth's girth / 2^zoom."""
    latitude, _ = layout.geographic_centre or (0.0, 0.0)
    extent = float(np.ptp(layout.corners[:, :2], axis=0).max())
    girth = 40_075_017.0 * np.cos(np.radians(latitude))
    return rrb.MapView(origin="/map", name="Map", zoom=float(np.log2(girth * _MAP_POINTS / 256 / max(extent, 100.0))))
