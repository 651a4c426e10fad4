"""A block of satellite scenes as a folder: project.toml that names the scenes, ground_points.csv, image_points.csv.

The folder is a block folder (`block_folder`) whose strips are satellite scenes: ``[scenes.NAME]`` of ``project.toml``
with their metadata takes the place of ``camera.json``, ``strips.csv`` and ``trajectory.csv``. docs/satellites.md has
the keys. Ground points and image points have the columns of any block folder; ``strip`` is the name of the scene.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...solver.adjustment.block_data import KnownPoints
from ...solver.geometry.ellipsoid import WGS84, Ellipsoid
from ...solver.geometry.frames import GEOGRAPHIC, BodyFrame, CrsError, Frame, LocalFrame
from ...solver.location.pushbroom import PushbroomSensor
from ...solver.location.rpc import Rpc
from ...solver.location.uncertainty import ground_derivatives
from ...solver.scene_adjustment.block import ImagePoints, KnownGround, SceneBlock
from ...solver.scene_adjustment.functional import (
    SHIFT_SIGMA_PX,
    SLOPE_SIGMA_PX,
    ProjectiveImage,
    R_e_enu,
    RpcImage,
)
from ...solver.scene_adjustment.images import ImageModel
from ...solver.scene_adjustment.rigorous import LensView, lens_view
from ..errors import UserError
from .block_folder import trajectory_settings, unknown_settings
from .ground_points import known_points, notes_of_names, read_ground_table
from .keys import Keys, read_toml
from .new_file import new_file
from .projection import notes_of_heights
from .satellite.read import read_scene
from .satellite.scene import SatelliteScene
from .table import Column, Table, read_table, write_table

Array = NDArray[np.floating]

#: Sigmas of the corrections where neither the project nor the metadata state them: what a satellite with GNSS and star
#: trackers has, rounded up. Tuned.
DEFAULTS: Mapping[str, object] = {
    "offset_sigma_m": [5.0, 5.0, 5.0],
    "shift_sigma_deg": [0.01, 0.01, 0.01],
    "drift_sigma_deg": [0.001, 0.001, 0.001],
    "first_sigma_m": [1.0, 1.0, 1.0],
    "first_sigma_deg": [0.001, 0.001, 0.001],
    "second_sigma_m": [0.5, 0.5, 0.5],
    "second_sigma_deg": [0.0005, 0.0005, 0.0005],
    "continuity_sigma_m": [0.1, 0.1, 0.1],
    "continuity_sigma_deg": [0.00001, 0.00001, 0.00001],
    "segments": 2,
}
#: Models that a scene may be adjusted with.
MODELS = ("rigorous", "rpc", "affine", "dlt")
#: Image points so far outside their scene cannot be used, pixels.
_OUTSIDE_PX = 0.5
#: A known point so many metres from where its pixels lie by the metadata has the coordinates of another place, and all
#: known points together if the median lies so far. Tuned: data snooping finds single points that are some degrees
#: off, but polynomials say anything of another continent; half a degree of attitude from 830 km up is less than the
#: second.
_OTHER_PLACE_M, _OTHER_SCENE_M = 1_000_000.0, 10_000.0
#: Both are at least so many sigmas of what the metadata and the point are known to.
_OTHER_SIGMAS = 5.0
#: The height of a point that needs none is known to that of the highest mountains, m.
_RELIEF_M = 9_000.0
#: Rows that cannot be used and are named one by one.
_MOST_NAMED = 5

#: Columns of image_points.csv.
IMAGE = (
    Column("point", "text"),
    Column("strip", "text"),
    Column("ccd", "text", optional=True, blank=True),
    Column("line"),
    Column("sample"),
    Column("sigma_px", optional=True, blank=True, above=0.0),
)


@dataclass(frozen=True)
class SceneEntry:
    """One scene of a block.

    Attributes
    ----------
    name : of the scene, the ``strip`` of its image points
    metadata : as project.toml writes it
    scene : what the metadata hold
    model : one of `MODELS`
    camera : scenes that name the same share their additional parameters
    images : names of the images by line of detectors, "" where the scene has one; none named where nothing is matched
    band : of the images, a number, a name or a weighted sum ("2:0.5,3:0.5"); "" for all
    first_pixel : column and row of the scene with which the images begin; None where nobody says
    """

    name: str
    metadata: str
    scene: SatelliteScene
    model: str
    camera: str
    images: Mapping[str, str] = field(default_factory=dict)
    band: str = ""
    first_pixel: tuple[int, int] | None = None


@dataclass(frozen=True)
class ImageEntry:
    """One image: a scene, or one of its lines of detectors.

    Attributes
    ----------
    scene : it belongs to
    ccd : its line of detectors, "" where the scene has one
    name : ``scene`` or ``scene/ccd``
    location : its rigorous model or polynomials
    view : image frame of its lens; None where there is no rigorous model
    """

    scene: SceneEntry
    ccd: str
    name: str
    location: PushbroomSensor | Rpc
    view: LensView | None

    @property
    def size_px(self) -> tuple[int, int] | None:
        """Lines and samples, where they are known."""
        lines, samples = self.location.lines, self.location.samples
        return (lines, samples) if lines and samples else None

    @property
    def image(self) -> str:
        """Name of its image as project.toml writes it, "" for none."""
        return self.scene.images.get(self.ccd) or self.scene.images.get("", "")


@dataclass(frozen=True)
class SceneBlockData:
    """A folder as arrays.

    Attributes
    ----------
    name : of the project
    frame : of the ground points
    images : of all scenes
    point_ids : of ground and image points
    rays : ``image`` is the place in `images`; only those that can be used
    ground : known points
    trajectory, then : the tables ``[trajectory]`` and ``[trajectory.then]``
    rpc : the table ``[rpc]``: correction, shift_sigma_px, slope_sigma_px
    ellipsoid : of the scenes
    notes : remarks for the user
    """

    name: str
    frame: Frame
    images: tuple[ImageEntry, ...]
    point_ids: tuple[str, ...]
    rays: ImagePoints
    ground: KnownPoints
    trajectory: Mapping[str, object]
    then: Mapping[str, object]
    rpc: Mapping[str, object]
    ellipsoid: Ellipsoid
    image_sigma_px: float
    notes: tuple[str, ...]

    def known(self) -> KnownGround:
        """Known points as the adjustment takes them."""
        place = {id: k for k, id in enumerate(self.point_ids)}
        position = self.ground.xyz_l @ self.frame.R_el.T + self.frame.origin_e
        lat, lon, _ = self.ellipsoid.geodetic(position).T
        R = np.swapaxes(R_e_enu(lat, lon), -1, -2) @ self.frame.R_el
        covariance = R @ self.ground.covariance @ np.swapaxes(R, -1, -2)
        return KnownGround(
            np.array([place[id] for id in self.ground.id], dtype=np.int64), position, covariance, self.ground.role
        )

    def trajectory_settings(self, images: Sequence[ImageEntry] | None = None) -> dict[str, object]:
        """Sigmas of the corrections: of the project, else of the metadata, else usual.

        Times of lines that are off move the ground as an offset along the track does, and across it as the Earth turns.

        Parameters
        ----------
        images : that share the corrections, whose largest sigmas count; None for all
        """
        rigorous = [e for e in (self.images if images is None else images) if e.scene.model == "rigorous"]
        found: dict[str, object] = {}
        if rigorous:
            stated = [e.scene.scene.sigmas for e in rigorous]
            late = [s.time_s * _offset_rate(e.location) for e, s in zip(rigorous, stated, strict=True) if s.time_s]
            position = _largest([s.position_m for s in stated], DEFAULTS["offset_sigma_m"])
            found["offset_sigma_m"] = np.hypot(position, np.max([np.zeros(3), *late], axis=0)).tolist()
            turns = [np.degrees(s.attitude_rad) for s in stated]
            found["shift_sigma_deg"] = _largest(turns, DEFAULTS["shift_sigma_deg"]).tolist()
        return {**DEFAULTS, **found, **self.trajectory}

    @property
    def rpc_sigmas_px(self) -> tuple[float, float]:
        """Of the shift and the slope that correct polynomials."""
        usual = {"shift_sigma_px": SHIFT_SIGMA_PX, "slope_sigma_px": SLOPE_SIGMA_PX}
        shift, slope = (float(str(self.rpc.get(key, value))) for key, value in usual.items())
        return shift, slope

    def block(self, images: tuple[ImageModel, ...]) -> SceneBlock:
        """The block of images made of `images`, in the same order."""
        return SceneBlock(images, self.point_ids, self.rays, self.known(), self.ellipsoid)

    def functional_image(self, entry: ImageEntry) -> RpcImage | ProjectiveImage:
        """The image of an entry whose model is not the rigorous one."""
        if entry.scene.model == "rpc":
            assert isinstance(entry.location, Rpc)
            affine = self.rpc.get("correction", "affine") == "affine"
            shift, slope = self.rpc_sigmas_px
            assumed = "shift_sigma_px" not in self.rpc, "slope_sigma_px" not in self.rpc
            return RpcImage(entry.name, entry.location, affine, shift, slope, entry.size_px, self.ellipsoid, assumed)
        return ProjectiveImage(entry.name, entry.scene.model, entry.size_px, self.ellipsoid)


def _largest(stated: Sequence[ArrayLike], usual: object) -> Array:
    """The largest of each component; for one that a scene does not state (0) the usual one stands."""
    values = np.asarray(stated, dtype=float)
    return np.where(values > 0, values, np.asarray(usual, dtype=float)).max(axis=0)


def _offset_rate(location: PushbroomSensor | Rpc) -> Array:
    """Offset of the orbit (3,), m/s along the track, across it and up, that moves the ground as a later time does."""
    assert isinstance(location, PushbroomSensor)
    J = ground_derivatives(location, [0.5 * (location.lines - 1)], [0.5 * (location.samples - 1)], [0.0])[0]
    return np.append(np.abs(np.linalg.solve(J[:2, :2], J[:2, 6])), 0.0) if np.isfinite(J).all() else np.zeros(3)


def is_scene_block(folder: Path) -> bool:
    """Whether a folder is a block of satellite scenes."""
    path = folder / "project.toml"
    if not path.is_file():
        return False
    try:
        return "scenes" in tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (ValueError, RecursionError):  # whoever reads it as a block says what is wrong with it
        return False


def read_scene_block(folder: Path, with_lines: bool = False) -> SceneBlockData:
    """Read a block of satellite scenes.

    Parameters
    ----------
    with_lines : whether image lines come with it, in which tie points are matched: none need be measured then, and
        scenes without image points take part, too

    Raises
    ------
    UserError : a file that is missing, a value that is missing or malformed, metadata that cannot be read, names that
        do not fit together
    """
    notes: list[str] = []
    file = read_toml(folder / "project.toml")
    project, apriori, trajectory = file.table("project"), file.table("apriori"), file.table("trajectory")
    name, crs = project.text("name", folder.resolve().name), project.text("crs", "EPSG:4979")
    sigma = apriori.number("image_sigma_px", 0.3, positive=True)
    settings, then = trajectory_settings(trajectory)
    of_rpc = file.table("rpc")
    rpc = _rpc_settings(of_rpc)
    scenes = _scenes(folder, file.table("scenes"), notes)
    for table in (file, project, apriori, of_rpc):
        notes.extend(f"project.toml: key {key} is not known and was ignored" for key in table.unread())
    notes.extend(unknown_settings(settings, then))
    images = _images(scenes)
    ellipsoid = _ellipsoid(folder, images)
    ground, frame = _ground(folder, crs, ellipsoid, notes)
    if with_lines and not (folder / "image_points.csv").exists():
        image_table = Table(folder / "image_points.csv", {c.name: np.empty(0) for c in IMAGE})
    else:
        image_table = read_table(folder / "image_points.csv", IMAGE, notes, may_be_empty=with_lines)
    ids, rays = _image_points(image_table, images, ground, sigma, notes)
    if not with_lines:
        used = np.unique(rays.image)
        unused = [image.name for k, image in enumerate(images) if k not in used]
        notes.extend(f"image {image}: no image points; it takes no part" for image in unused)
        images = tuple(images[k] for k in used)
        rays = replace(rays, image=np.searchsorted(used, rays.image))
    data = SceneBlockData(name, frame, images, ids, rays, ground, settings, then, rpc, ellipsoid, sigma, tuple(notes))
    _refuse_other_places(folder / "ground_points.csv", data)
    return data


def _rpc_settings(table: Keys) -> dict[str, object]:
    settings: dict[str, object] = {"correction": table.text("correction", "affine")}
    if settings["correction"] not in ("affine", "shift"):
        raise table.refuse("correction", "affine or shift")
    for key in ("shift_sigma_px", "slope_sigma_px"):
        if table.has(key):  # usual ones are no knowledge of the data
            settings[key] = table.number(key, positive=True)
    return settings


def _scenes(folder: Path, table: Keys, notes: list[str]) -> list[SceneEntry]:
    if not table.values:
        raise UserError(f"{table.path}: scenes: none, wanted a table [scenes.NAME] with metadata for each scene")
    entries = []
    for name in table.values:
        keys = table.table(name)
        metadata = keys.text("metadata")
        scene = read_scene(folder / metadata)
        rigorous = scene.sensor is not None
        model = keys.text("model", "rigorous" if rigorous else "rpc")
        if model not in MODELS:
            raise keys.refuse("model", f"one of {', '.join(MODELS)}")
        if model == "rigorous" and not rigorous:
            raise keys.refuse("model", f"another model: {metadata} has no rigorous one")
        if model == "rpc" and scene.rpc is None:
            raise keys.refuse("model", f"another model: {metadata} has no rational polynomials")
        camera = keys.text("camera", scene.camera or name)
        images, band, first = _images_of(keys, list(scene.sensors)), str(keys.raw("band", "")), None
        if keys.has("first_pixel"):
            column, row = keys.numbers("first_pixel", 2, low=0.0)
            if (column, row) != (int(column), int(row)):
                raise keys.refuse("first_pixel", "column and row, two integers")
            first = int(column), int(row)
        notes.extend(f"scene {name}: {note}" for note in scene.notes)
        notes.extend(f"project.toml: key {key} is not known and was ignored" for key in keys.unread())
        entries.append(SceneEntry(name, metadata, scene, model, camera, images, band, first))
    return entries


def _images_of(keys: Keys, lines: list[str]) -> dict[str, str]:
    """Names of the images of a scene by its lines of detectors; one name where it has one line."""
    if not keys.has("image"):
        return {}
    if not isinstance(keys.raw("image"), Mapping):
        if len(lines) > 1:
            raise keys.refuse("image", f"an image for each of the lines {', '.join(lines)}: {{ {lines[0]} = .. }}")
        return {"": keys.text("image")}
    table = keys.table("image")
    for line in table.values:
        if line not in lines:
            wanted = f"one of the lines {', '.join(lines)}" if lines else "the name of an image: the scene has one line"
            raise UserError(f"{table.path}: {table.name(line)}: wanted {wanted}")
    return {line: table.text(line) for line in table.values}


def _images(scenes: list[SceneEntry]) -> tuple[ImageEntry, ...]:
    images = []
    for entry in scenes:
        scene = entry.scene
        if entry.model == "rpc" or scene.sensor is None:
            assert scene.rpc is not None
            images.append(ImageEntry(entry, "", entry.name, scene.rpc, None))
            continue
        sensors = scene.sensors if len(scene.sensors) > 1 else {next(iter(scene.sensors), ""): scene.sensor}
        for ccd, sensor in sensors.items():
            view = scene.views.get(ccd) or lens_view(sensor)
            name = f"{entry.name}/{ccd}" if len(sensors) > 1 else entry.name
            images.append(ImageEntry(entry, ccd, name, sensor, view))
    return tuple(images)


def _ellipsoid(folder: Path, images: tuple[ImageEntry, ...]) -> Ellipsoid:
    """The ellipsoid that all scenes stand on."""
    found: dict[Ellipsoid, str] = {}
    for image in images:
        found.setdefault(getattr(image.location, "ellipsoid", WGS84), image.name)
    if len(found) > 1:
        first, second = list(found.values())[:2]
        raise UserError(f"{folder}: scenes {first} and {second} have different ellipsoids, wanted scenes of one planet")
    return next(iter(found))


def _ground(folder: Path, crs: str, ellipsoid: Ellipsoid, notes: list[str]) -> tuple[KnownPoints, Frame]:
    path = folder / "ground_points.csv"
    if abs(ellipsoid.semi_major_m / WGS84.semi_major_m - 1.0) > 1e-3 and crs != GEOGRAPHIC:
        raise UserError(
            f"{folder / 'project.toml'}: project.crs: {crs!r} with scenes of another planet, wanted "
            f'"{GEOGRAPHIC}" (longitude, latitude, height on the ellipsoid of the scenes)'
        )
    table = Table(path, {})
    if path.is_file():
        table = read_ground_table(path, crs, notes, may_be_empty=True)
    rows = len(table) if table.values else 0
    if not rows:
        notes.append("ground_points.csv: no points: the block stands on its orbits or polynomials alone")
    if crs == GEOGRAPHIC:
        frame: Frame = BodyFrame(ellipsoid)
    else:
        middle = table.stack("X_m", "Y_m", "Z_m") if rows else np.empty((0, 3))
        middle = middle[np.isfinite(middle).all(axis=1)]
        try:
            frame = LocalFrame.around(middle, crs) if len(middle) else LocalFrame(0.0, 0.0, 0.0, crs)
            told = notes_of_heights(crs)
        except CrsError as error:
            raise UserError(f"{folder / 'project.toml'}: project.crs: {error}") from None
        notes.extend(f"project.toml: {note}" for note in told)
    if not rows:
        return KnownPoints((), np.empty((0, 3)), np.empty((0, 3, 3)), ()), frame
    return known_points(table, frame, notes), frame


def _image_points(
    table: Table, images: tuple[ImageEntry, ...], ground: KnownPoints, sigma_px: float, notes: list[str]
) -> tuple[tuple[str, ...], ImagePoints]:
    place = {(image.scene.name, image.ccd): k for k, image in enumerate(images)}
    only = {}  # where a scene has one line of detectors its name need not be written
    for k, image in enumerate(images):
        only[image.scene.name] = k if image.scene.name not in only else -1
    scene = table["strip"]
    ccd = table["ccd"] if "ccd" in table else np.full(len(table), "", dtype=object)
    image_of = np.empty(len(table), dtype=np.int64)
    unusable: list[str] = []
    for row, key in enumerate(zip(scene, ccd, strict=True)):
        alone = only.get(key[0], -1)
        other = alone >= 0 and key[1] and images[alone].ccd  # a line of another name
        image_of[row] = place.get(key, -1 if other else alone)
        if image_of[row] < 0:
            what = f"strip: {key[0]!r} is not in project.toml"
            if key[0] in only:
                lines = ", ".join(i.ccd for i in images if i.scene.name == key[0])
                what = f"ccd: {key[1]!r} is none of scene {key[0]}, which has {lines}"
            unusable.append(f"image_points.csv:{table.line_of(row)}: {what}; the ray cannot be used")
    line, sample = table["line"], table["sample"]
    usable = image_of >= 0
    for k, image in enumerate(images):
        mine = image_of == k
        # where the image begins is known, be its size known or not
        size = image.size_px or (np.inf, np.inf)
        low, high = -_OUTSIDE_PX, np.array(size) - 1.0 + _OUTSIDE_PX
        outside = mine & ~((line >= low) & (line <= high[0]) & (sample >= low) & (sample <= high[1]))
        usable &= ~outside
        of_size = f" of {size[0]} lines and {size[1]} samples" if image.size_px else ""
        for row in np.flatnonzero(outside):
            unusable.append(
                f"image_points.csv:{table.line_of(int(row))}: line: {line[row]:g}, sample {sample[row]:g} lies outside "
                f"image {image.name}{of_size}; the ray cannot be used"
            )
    notes.extend(unusable[:_MOST_NAMED])
    if len(unusable) > _MOST_NAMED:
        notes.append(f"image_points.csv: {len(unusable) - _MOST_NAMED} more rays cannot be used")
    rows = np.flatnonzero(usable)
    twice = _repeats(table["point"][rows], image_of[rows], line[rows], sample[rows])
    if twice.any():
        notes.append(f"image_points.csv: {twice.sum()} rows repeat a measurement and were left out")
        rows = rows[~twice]
    if not len(rows) and unusable:
        raise UserError(f"{table.path}: no row that can be used; the first: {unusable[0]}")
    ids: dict[str, int] = {id: k for k, id in enumerate(ground.id)}
    point = np.array([ids.setdefault(str(id), len(ids)) for id in table["point"][rows]], dtype=np.int64)
    notes.extend(notes_of_names(tuple(ids), len(ground), point))
    sigma = np.full(len(rows), sigma_px)
    if "sigma_px" in table:
        stated = table["sigma_px"][rows]
        sigma = np.where(np.isnan(stated), sigma, stated)
    return tuple(ids), ImagePoints(image_of[rows], point, line[rows], sample[rows], sigma)


def _refuse_other_places(path: Path, data: SceneBlockData) -> None:
    """Refuse known points that lie elsewhere than the metadata see them: their pixels, at their heights.

    Raises
    ------
    UserError : naming the point that is farthest off, or how far all of them are
    """
    ground, ellipsoid = data.ground, data.ellipsoid
    position = ground.xyz_l @ data.frame.R_el.T + data.frame.origin_e
    height = ellipsoid.geodetic(position)[:, 2] if len(ground) else np.empty(0)
    placed = np.array([role != "height" for role in ground.role], dtype=bool)
    sigma = np.sqrt(np.einsum("nii->n", ground.covariance))
    sigma_up = np.where([role == "planimetric" for role in ground.role], _RELIEF_M, sigma)
    away, known_to = np.full(len(ground), np.inf), np.zeros(len(ground))
    for k, image in enumerate(data.images):
        mine = np.flatnonzero((data.rays.image == k) & (data.rays.point < len(ground)))
        mine = mine[placed[data.rays.point[mine]]]
        if image.scene.model not in ("rigorous", "rpc") or not len(mine):  # the others know nothing beforehand
            continue
        point, line, sample = data.rays.point[mine], data.rays.line[mine], data.rays.sample[mine]
        with np.errstate(all="ignore"):  # a ray that misses the ground says nothing
            lat, lon, _ = image.location.direct(line, sample, height[point]).T
            off = np.linalg.norm(ellipsoid.cartesian(lat, lon, height[point]) - position[point], axis=1)
            by_metadata, by_height = _known_to(data, image, line, sample, height[point])
        np.fmin.at(away, point, off)
        np.fmax.at(known_to, point, np.hypot(np.hypot(by_metadata, sigma[point]), by_height * sigma_up[point]))
    seen = np.flatnonzero(np.isfinite(away))
    if not len(seen):
        return
    away, most = away[seen], _OTHER_SIGMAS * known_to[seen]
    by = "from where their pixels lie by the metadata"
    wanted = "longitude first (X), then latitude (Y)" if data.frame.units[0] == "deg" else f"places in {data.frame.crs}"
    stated = "or larger sigmas in project.toml ([trajectory], [rpc])"
    if np.median(away / np.maximum(most, _OTHER_SCENE_M)) > 1.0:
        raise UserError(
            f"{path}: {len(seen)} known points lie {1e-3 * np.median(away):.0f} km (median) {by}, wanted {wanted}, and "
            f"the metadata of these scenes, {stated}"
        )
    beyond = away / np.maximum(most, _OTHER_PLACE_M)
    worst = int(np.argmax(beyond))
    if beyond[worst] > 1.0:
        by = by.replace("their", "its")
        raise UserError(
            f"{path}: point {ground.id[seen[worst]]} lies {1e-3 * away[worst]:.0f} km {by}, wanted {wanted}, {stated}"
        )


def _known_to(
    data: SceneBlockData, image: ImageEntry, line: Array, sample: Array, height: Array
) -> tuple[Array, Array]:
    """Sigma (n,), m, of the places of pixels by what is known of an image beforehand, and their change by a height.

    By the rays themselves: what an attitude does on the ground grows with the distance, and with the obliquity.
    """
    location, ellipsoid = image.location, data.ellipsoid
    if isinstance(location, PushbroomSensor):
        settings = data.trajectory_settings([image])
        offset, turn = (np.asarray(settings[key], dtype=float) for key in ("offset_sigma_m", "shift_sigma_deg"))
        J = np.linalg.norm(ground_derivatives(location, line, sample, height)[:, :2], axis=1)
        return np.linalg.norm(J[:, :6] * [*offset, *np.radians(turn)], axis=1), J[:, 9]

    def place(line: Array, sample: Array, height: Array) -> Array:
        lat, lon, h = location.direct(line, sample, height).T
        return ellipsoid.cartesian(lat, lon, h)

    at = place(line, sample, height)
    moved = [place(line + 1.0, sample, height) - at, place(line, sample + 1.0, height) - at]
    up = ellipsoid.normal_and_height(at)[0]
    by_height = np.linalg.norm(place(line, sample, height + 1.0) - at - up, axis=1)
    shift, slope = data.rpc_sigmas_px
    pixels = np.hypot(shift, np.sqrt(2.0) * slope)
    return np.hypot(pixels * np.linalg.norm(moved, axis=(0, 2)), location.error_bias_m), by_height


def _repeats(*columns: NDArray[np.generic]) -> NDArray[np.bool_]:
    """Rows (n,) that are the same as one before."""
    seen: set[tuple[object, ...]] = set()
    out = np.zeros(len(columns[0]), dtype=bool)
    for row, key in enumerate(zip(*(c.tolist() for c in columns), strict=True)):
        out[row] = key in seen
        seen.add(key)
    return out


def write_scene_block(
    folder: Path,
    name: str,
    scenes: Mapping[str, Mapping[str, str]],
    block: SceneBlock | None = None,
    images: Sequence[str] | None = None,
    *,
    image_sigma_px: float = 0.3,
    trajectory: Mapping[str, object] | None = None,
) -> None:
    """Write a folder that `read_scene_block` reads.

    Parameters
    ----------
    folder : made if it is not there
    name : of the project
    scenes : for each scene its keys (``metadata``, ``model``, ``camera``)
    block : its points; None for tables with their header alone
    images : names of its images in the files, ``scene`` or ``scene/ccd``; None for those of the block
    image_sigma_px : of image points that state none
    trajectory : sigmas of the corrections
    """
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["[project]", f"name = {json.dumps(name)}", 'crs = "EPSG:4979"  # longitude, latitude, ellipsoidal height']
    lines += ["[apriori]", f"image_sigma_px = {image_sigma_px!r}"]
    if trajectory:
        lines += ["[trajectory]"]
        lines += [f"{key} = {json.dumps(value)}" for key, value in trajectory.items()]
    for scene, keys in scenes.items():
        lines += [f"[scenes.{json.dumps(scene)}]", *(f"{key} = {json.dumps(value)}" for key, value in keys.items())]
    with new_file(folder / "project.toml") as part:
        part.write_text("\n".join([*lines, ""]), encoding="utf-8")
    known = KnownGround.none() if block is None else block.known
    ids = np.array(() if block is None else block.point_ids, dtype=object)
    ellipsoid = WGS84 if block is None else block.ellipsoid
    lat, lon, height = ellipsoid.geodetic(known.position_e).T if len(known.point) else np.empty((3, 0))
    sigma = np.sqrt(np.einsum("nii->ni", known.covariance_enu)).reshape(-1, 3)
    write_table(
        folder / "ground_points.csv",
        {"point": ids[known.point], "X_m": np.degrees(lon), "Y_m": np.degrees(lat), "Z_m": height}
        | {f"sigma_{axis}_m": sigma[:, k] for k, axis in enumerate("XYZ")}
        | {"role": known.role},
        {"X_m": ".10f", "Y_m": ".10f", "Z_m": ".4f"} | {f"sigma_{axis}_m": ".6g" for axis in "XYZ"},
    )
    names = list(images) if images is not None else [image.name for image in block.images] if block else []
    image_of = np.empty(0, dtype=np.int64) if block is None else block.rays.image
    parts = [(n, "") if n in scenes else tuple(n.rsplit("/", 1)) for n in names]
    empty = np.empty(0)
    write_table(
        folder / "image_points.csv",
        {
            "point": ids[block.rays.point] if block is not None else empty,
            "strip": [parts[k][0] for k in image_of],
            "ccd": [parts[k][1] for k in image_of],
            "line": block.rays.line if block is not None else empty,
            "sample": block.rays.sample if block is not None else empty,
            "sigma_px": block.rays.sigma_px if block is not None else empty,
        },
        {"line": ".5f", "sample": ".5f", "sigma_px": ".6g"},
    )
