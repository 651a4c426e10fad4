"""Tie points between the images of a block of satellite scenes: opens the images, matches, writes image_points.csv."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...solver.geometry.ellipsoid import WGS84
from ...solver.location.pushbroom import PushbroomSensor
from ...solver.location.rpc import Rpc
from ...solver.location.uncertainty import ground_covariance
from ...solver.matching.scene_patches import SceneView
from ...solver.matching.scene_ties import ELSEWHERE, PairReport, SceneMatcher, SceneMatching, ScenePoint
from ..errors import UserError
from ..formats.matched_points import MatchedLook, write_matched_points
from ..formats.satellite.read import read_scene
from ..formats.scene_block import ImageEntry, SceneBlockData
from .scene_pixels import Tiles, image_of, open_scene_image

Array = NDArray[np.floating]

#: How far apart the models of two images may put the same place, m, where no sigmas say more: what GNSS and star
#: trackers leave, some tens of metres.
SEARCH_M = 50.0
#: Heights that are thought possible where neither RPC, control nor the user say any, m.
LOW_M, HIGH_M = -100.0, 3000.0
#: Polynomials of an image are those of a scene that they are so much nearer to than to its own.
TAKEN_FOR = 0.1
#: The ground lies no further below or above control than this, m.
BEYOND_M = 200.0


@dataclass(frozen=True)
class MatchedScenes:
    """What was found.

    Attributes
    ----------
    data : the block
    points : tie points; images by their place in ``data.images``
    pairs : a report of each pair of images
    search_m, low_m, high_m : what was searched
    notes : remarks for the user
    """

    data: SceneBlockData
    points: list[ScenePoint]
    pairs: list[PairReport]
    search_m: float
    low_m: float
    high_m: float
    notes: list[str]


def open_views(folder: Path, data: SceneBlockData) -> tuple[SceneBlockData, list[SceneView]]:
    """The images of a block with their models, and the block without images that nobody names.

    Raises
    ------
    UserError : fewer than two images, or images that cannot be read or do not go with their scenes
    """
    paths = [image_of(folder, entry) for entry in data.images]
    named = [(entry, path) for entry, path in zip(data.images, paths, strict=True) if path is not None]
    lost = [entry for entry, path in zip(data.images, paths, strict=True) if path is None]
    project = folder / "project.toml"
    if len(named) < 2:
        if not lost:
            raise UserError(f"{project}: scenes: one image, wanted two or more that see the same ground")
        scene = lost[0].scene
        wanted = f'{{ {lost[0].ccd} = "IMG.TIF", .. }}' if len(scene.scene.sensors) > 1 else '"IMG.TIF"'
        raise UserError(f"{project}: scenes.{scene.name}.image: missing, wanted its image: image = {wanted}")
    notes = [*data.notes]
    if lost:
        notes.append(f"no image of {', '.join(entry.name for entry in lost)}: not matched")
    tiles = Tiles()
    views = [SceneView(e.name, e.location, open_scene_image(path, e, tiles, notes)) for e, path in named]
    return replace(data, images=tuple(entry for entry, _ in named), notes=tuple(notes)), views


def mistaken_images(folder: Path, data: SceneBlockData, views: list[SceneView]) -> list[str]:
    """What is said of images whose own polynomials are those of another scene, as of two that were swapped.

    Parameters
    ----------
    data, views : of `open_views`
    """
    notes = []
    for k, entry in enumerate(data.images):
        path = image_of(folder, entry)
        assert path is not None
        try:
            own = read_scene(path).rpc
        except UserError:  # most have none
            continue
        if own is None:
            continue
        first = views[k].pixels.first
        line, sample = views[k].grid(3).T
        height = np.full(len(line), own.to_image.in_offset[2])
        with np.errstate(invalid="ignore", divide="ignore"):
            said = WGS84.cartesian(*own.direct(line - first[0], sample - first[1], height).T)
            off = [float(np.linalg.norm(_ground(view, line, sample, height) - said, axis=1).mean()) for view in views]
        nearest = int(np.nanargmin(off)) if np.isfinite(off).any() else k
        if off[nearest] < TAKEN_FOR * off[k]:
            notes.append(
                f"{path.name}: the polynomials in it or beside it are those of scene {views[nearest].name}, not of "
                f"{views[k].name}: are these the right images?"
            )
    return notes


def _ground(view: SceneView, line: Array, sample: Array, height_m: Array) -> Array:
    """Earth-fixed (n, 3), m, where pixels lie at heights by the model of a view; NaN for none."""
    return WGS84.cartesian(*view.location.direct(line, sample, height_m).T)


def match_scenes(
    data: SceneBlockData, views: list[SceneView], points: int, *, search_m: float | None = None,
    heights: tuple[float, float] | None = None, height_m: Callable[[SceneView, Array], Array] | None = None,
    told: Callable[[float], None] | None = None,
) -> MatchedScenes:  # fmt: skip
    """Find the tie points.

    Parameters
    ----------
    points : wanted in each pair
    search_m : how far apart two models may put the same place; None for what the metadata say
    heights : lowest and highest of the ground; with ``height_m`` how wrong its heights may be
    height_m : heights (k,) under pixels (k, 2) of a view

    Raises
    ------
    UserError : images that do not overlap, or nothing that is found in two of them
    """
    notes: list[str] = []
    low, high = heights or _heights(data, notes)
    far = search_m or _search_m(data)
    with np.errstate(invalid="ignore", divide="ignore"):
        found, reports = SceneMatcher(views, SceneMatching(points, low, high, height_m, far), told).match()
    if all(report.why == ELSEWHERE for report in reports):
        at = "the heights given" if height_m else f"heights from {low:.0f} to {high:.0f} m"
        raise UserError(f"{data.name}: no two images overlap at {at}: {', '.join(view.name for view in views)}")
    if not found:
        first = next(report for report in reports if report.why != ELSEWHERE)
        raise UserError(f"{data.name}: no tie points: {' and '.join(first.names)}: {first.why}")
    return MatchedScenes(data, found, reports, far, low, high, notes)


def write_points(matched: MatchedScenes, source: Path, target: Path) -> tuple[int, int]:
    """Write image_points.csv, see `write_matched_points`."""
    images = matched.data.images
    looks = (
        MatchedLook(number, images[k].scene.name, images[k].ccd, *ray)
        for number, point in enumerate(matched.points)
        for k, ray in sorted(point.rays.items())
    )
    return write_matched_points(source, target, looks, set(matched.data.ground.id))


def _heights(data: SceneBlockData, notes: list[str]) -> tuple[float, float]:
    """Lowest and highest ground: of the RPC, or of control, or usual."""
    rpcs = [rpc for e in data.images if (rpc := e.location if isinstance(e.location, Rpc) else e.scene.scene.rpc)]
    if rpcs:
        middle, half = (np.array([getattr(r.to_image, name)[2] for r in rpcs]) for name in ("in_offset", "in_scale"))
        return float((middle - np.abs(half)).min()), float((middle + np.abs(half)).max())
    known = data.known()
    z = data.ellipsoid.geodetic(known.position_e)[:, 2] if len(known.point) else np.empty(0)
    z = z[known.given[:, 2] | np.array([role == "check" for role in known.role], dtype=bool)] if len(z) else z
    if len(z):
        return float(z.min()) - BEYOND_M, float(z.max()) + BEYOND_M
    notes.append(f"heights of the ground from {LOW_M:g} to {HIGH_M:g} m: --height LOW HIGH or --dem say more")
    return LOW_M, HIGH_M


def _search_m(data: SceneBlockData) -> float:
    """Three sigma of the difference of two models on the ground, as far as sigmas are stated, or `SEARCH_M`."""
    sigmas = sorted(_ground_sigma_m(data, entry) for entry in data.images)
    return max(3.0 * float(np.linalg.norm(sigmas[-2:])), SEARCH_M)


def _ground_sigma_m(data: SceneBlockData, entry: ImageEntry) -> float:
    """Planimetric sigma of a location with the sigmas that project or metadata state, m; 0 for none."""
    location, size = entry.location, entry.size_px
    if not isinstance(location, PushbroomSensor) or size is None:
        return 0.0
    stated = entry.scene.scene.sigmas
    offset, shift = data.trajectory.get("offset_sigma_m"), data.trajectory.get("shift_sigma_deg")
    if offset is not None:
        stated = replace(stated, position_m=tuple(np.asarray(offset, dtype=float).tolist()))
    if shift is not None:
        stated = replace(stated, attitude_rad=tuple(np.radians(np.asarray(shift, dtype=float)).tolist()))
    stated = replace(stated, height_m=0.0)
    if not stated.any:
        return 0.0
    C = ground_covariance(location, [0.5 * (size[0] - 1)], [0.5 * (size[1] - 1)], [0.0], stated)[0]
    return float(np.sqrt(np.linalg.eigvalsh(C[:2, :2])[-1])) if np.isfinite(C).all() else 0.0
