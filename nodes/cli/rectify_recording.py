"""What ``triline rectify`` needs of a recording: camera, orientation, ground, cells."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...solver.camera.line_camera import LineCamera
from ...solver.geometry.ellipsoid import WGS84
from ...solver.geometry.frames import LocalFrame
from ...solver.matching.round_earth import tilt
from ...solver.orthoimage.error_band import GroundErrors
from ...solver.orthoimage.ground_grid import CellWindow, GroundGrid, metres_a_unit, utm_of
from ...solver.orthoimage.orientation import LineOrientation
from ...solver.orthoimage.surface import Ellipsoid, HeightField, Surface, UnderAir
from ...solver.rectification.relief_shadows import ReliefShadows
from ..batch.rectification import frame_for, line_blocks, pixel_on_ground
from ..batch.relief import ground_of_points, known_points
from ..batch.strip_orientation import REFINED, OfStrips, OfTable, camera_beside, estimated_camera, orientation_of
from ..config import raster_of_heights
from ..errors import UserError
from ..formats.camera_json import read_camera_instead
from ..formats.dem import dem_in_frame
from ..recording.access import Recording
from .heights_under import NO_HEIGHT_SIGMA
from .location_options import refraction_of

#: An orthoimage with more cells than this is refused: the mosaic is put together in memory.
MOST_CELLS = 4e9
#: Note where nobody asked for the truth.
TRUTH_ALONE = (
    "the recording has no orientation but the truth of its simulation, which is taken, with sigmas of 0; "
    "'triline process' makes one of its sensor data"
)


@dataclass(frozen=True)
class Prepared:
    """A recording that is ready to be rectified.

    Attributes
    ----------
    camera, ccd : camera, and the index of its CCD line
    orientation_name, orientation, reference_ns : of the lines
    of_strip : orientation of each strip, by its name; None of one that a table has not
    estimated, of_camera : how many parameters of the camera were estimated; the file of the camera, if it has one
    target : the local frame with the CRS of the cells
    surface, ground : what rays meet, and its name
    shadows : what the relief hides, None where nobody asked for it
    errors : what counts for the sigmas besides the orientation, None where nobody asked for them
    pixel_m : size of a pixel on the ground
    notes : remarks on the camera's file
    """

    recording: Recording
    camera: LineCamera
    ccd: int
    orientation_name: str
    orientation: LineOrientation
    reference_ns: int
    of_strip: Callable[[str], LineOrientation | None]
    estimated: int
    of_camera: Path | None
    target: LocalFrame
    surface: Surface
    ground: str
    shadows: ReliefShadows | None
    errors: GroundErrors | None
    pixel_m: float
    notes: tuple[str, ...]


def prepared(args: argparse.Namespace, path: Path) -> Prepared:
    """What the command line asks for, of one recording.

    Raises
    ------
    UserError : the recording does not have it
    """
    recording = Recording(path)
    camera = recording.camera()
    ccd = _ccd(recording, camera, args.ccd)
    if not args.mosaic:
        check_strips(recording, args.strip)
    of_camera = None
    notes: list[str] = []
    if args.trajectory is not None:
        name = args.trajectory.name
        of_strip = OfTable(recording, args.trajectory, args.strip, camera.lines[ccd].lens)
        orientation, reference_ns = of_strip.orientation, of_strip.reference_ns
        if of_strip.missing and not args.strip:
            notes.append(f"{name} has no rows of strip {', '.join(of_strip.missing)}")
        if args.camera is None:
            camera, of_camera = camera_beside(args.trajectory, camera, notes)
    else:
        name, orientation, reference_ns = orientation_of(recording, args.orientation)
        of_strip = OfStrips(recording, name, orientation, reference_ns)
        if name == "truth" and args.orientation is None and not args.mosaic:
            notes.append(TRUTH_ALONE)
    estimated = 0
    if args.camera is not None:
        camera, of_camera = read_camera_instead(args.camera, camera, notes=notes), args.camera
    elif name in REFINED:
        camera, estimated = estimated_camera(recording, camera)
    frame = recording.frame()
    target = frame_for(frame, args.crs or _crs(frame))
    surface, ground_m, ground = _ground(args, recording, frame)
    shadows = ReliefShadows(surface) if args.occlusions and isinstance(surface, HeightField) else None
    if args.refraction is not None:
        surface = UnderAir(surface, frame, refraction_of(args.refraction, WGS84, str(path)))
        ground += ", refraction taken off"
    errors = _errors(args, path, camera, ccd, name, orientation)
    if errors is not None and args.height_sigma is None and not args.mosaic:
        notes.append(NO_HEIGHT_SIGMA)
    above = float(np.median(orientation.measured.position_l[:, 2])) - ground_m
    if above <= 0:
        raise UserError(f"{path}: the camera is {-above:.0f} m below the ground; wanted another --height or --dem")
    return Prepared(
        recording, camera, ccd, name, orientation, reference_ns, of_strip, estimated, of_camera, target, surface,
        ground, shadows, errors, pixel_on_ground(camera, ccd, above), tuple(notes),
    )  # fmt: skip


def cells_of(args: argparse.Namespace, of: Prepared) -> tuple[GroundGrid, int, CellWindow | None]:
    """The cells, how many pixels are put together each way, and the part that is wanted, None for all.

    Raises
    ------
    UserError : too many cells
    """
    grid = GroundGrid(of.target, args.gsd or float(f"{of.pixel_m / metres_a_unit(of.target):.2g}"))
    part = None if args.bounds is None else grid.window(*args.bounds)
    if not args.mosaic:  # a mosaic is not held in memory
        _check_size(of.recording, of.camera, of.ccd, of.pixel_m, grid, part)
    return grid, pixels_together(grid, of.pixel_m), part


def pixels_together(grid: GroundGrid, pixel_m: float) -> int:
    """How many pixels each way are put together, where cells are so much larger."""
    return max(int(grid.cell_m / pixel_m + 0.1), 1)


def _ccd(recording: Recording, camera: LineCamera, wanted: str | None) -> int:
    path = recording.reader.path
    imaged = [line.id for line in camera.lines if len(recording.reader.select([f"sensor/lines/{line.id}"]))]
    if not imaged:
        raise UserError(f"{path}: no image lines in it (sensor/lines); 'triline simulate --images' makes some")
    if wanted is not None:
        if wanted not in imaged:
            raise UserError(f"{path}: no image lines of CCD line {wanted!r}, there are: {', '.join(imaged)}")
        return camera.line_index[wanted]
    if len(camera.lenses) > 1:  # each looks by itself: poses say where
        try:
            return camera.line_index[min(imaged, key=_tilts(recording, camera, imaged).__getitem__)]
        except UserError:  # no poses: orientation of a table, or none, which is told later
            pass
    return min((camera.line_index[id] for id in imaged), key=lambda k: abs(float(camera.ahead_mm[k])))


def _tilts(recording: Recording, camera: LineCamera, imaged: list[str]) -> dict[str, float]:
    """Angle (rad) between the way down and where each CCD line looks, at the first image line that has a pose."""
    name, orientation, reference_ns = orientation_of(recording, None)
    of_strip = OfStrips(recording, name, orientation, reference_ns)
    tilts = {}
    for id in imaged:
        ccd = camera.line_index[id]
        middle = camera.lines[ccd].centre_mm - camera.principal_point_mm[ccd]
        tilts[id] = np.inf
        for block in line_blocks(recording, id, None):
            own = of_strip(block.strip)
            time_s = (block.times_ns() - reference_ns) * 1e-9
            if (posed := own.covers(time_s)).any():
                position, R = own.at(time_s[posed][:1])
                tilts[id] = tilt(position[0], R[0] @ [*middle, -camera.focal_length_mm[ccd]])
                break
    return tilts


def check_strips(recording: Recording, wanted: list[str] | None) -> None:
    there = list(recording.last_strips())
    for strip in wanted or ():
        if strip not in there:
            raise UserError(f"{recording.reader.path}: no strip {strip!r}, there are: {', '.join(there)}")


def _crs(frame: LocalFrame) -> str:
    """The horizontal CRS of the project, or its UTM zone; local where the place of the project is not known."""
    if frame.crs == "local":
        return utm_of(frame) if frame.is_placed else "local"
    import pyproj

    crs = pyproj.CRS.from_user_input(frame.crs)
    flat = crs.sub_crs_list[0] if crs.is_compound else crs
    return flat.to_string() if flat.is_projected else utm_of(frame)


def _ground(args: argparse.Namespace, recording: Recording, frame: LocalFrame) -> tuple[Surface, float, str]:
    """The ground, its mean height in the local frame, and its name."""
    if args.dem == ["points"]:
        field = ground_of_points(recording)
        return field, float(np.median(known_points(recording)[:, 2])), "heights of object points"
    if args.dem is not None:
        path, crs = Path(args.dem[0]), args.dem_crs
        if (path / "flight.toml").is_file():
            if crs is not None:
                raise UserError(f"--dem-crs: [dem] of {path / 'flight.toml'} says it")
            path, crs = raster_of_heights(path / "flight.toml")
        field = dem_in_frame(path, frame, crs)
        if not np.isfinite(field.z_m).any():
            raise UserError(f"{path}: lies far from the project")
        return field, float(np.nanmedian(field.z_m)), f"heights of {path.name}"
    if args.height is not None:
        h = args.height
    else:
        points = known_points(recording)
        h = float(np.median(frame.to_geodetic(points)[:, 2])) if len(points) else frame.height_m
    return Ellipsoid(frame, h), h - frame.height_m, f"height {h:.1f} m above the ellipsoid"


def _errors(
    args: argparse.Namespace, path: Path, camera: LineCamera, ccd: int, name: str, orientation: LineOrientation
) -> GroundErrors | None:
    """What counts for the sigmas besides the orientation; None where nobody asked for them."""
    if args.sigma is None:
        return None
    if args.trajectory is not None:
        raise UserError(f"--sigma: {name} has sigmas without their correlations, wanted --orientation of the recording")
    if not orientation.has_covariance:
        raise UserError(f"{path}: --sigma: the {name} orientation has no covariance")
    xy = camera.lines[ccd].xy_mm
    pitch_mm = float(np.linalg.norm(xy[-1] - xy[0])) / (len(xy) - 1)
    return GroundErrors((args.pixel_sigma or 0.0) * pitch_mm, args.height_sigma or 0.0)


def _check_size(
    recording: Recording, camera: LineCamera, ccd: int, pixel: float, grid: GroundGrid, part: CellWindow | None
) -> None:
    if part is None:
        lines = max((int(message.body.lines) for message in recording.messages("configuration/strip")), default=0)
        cells, more = lines * camera.lines[ccd].pixels * (pixel / grid.cell_m) ** 2, ", or --bounds of a part"
    else:
        cells, more = part.shape[0] * part.shape[1], ", or a smaller part"
    if cells > MOST_CELLS:
        raise UserError(
            f"--gsd {grid.gsd:g}: some {cells:.1g} cells, wanted at most {MOST_CELLS:.0e}: choose a larger one{more}"
        )
