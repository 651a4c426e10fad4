"""A simulated block of satellite scenes as a folder: metadata, control, image points, and the truth beside them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from heapq import merge
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ...schemas.image_lines import LineBlock
from ...schemas.topics import rank
from ...solver.adjustment.block_data import BlockData
from ...solver.location.pushbroom import PushbroomSensor
from ...solver.models.dgr import DgrOptions
from ...solver.orbit.time_scales import iso_utc, parse_time
from ...solver.scene_adjustment.block import Layout
from ...solver.simulation.orbital_imagery import render, texture_of
from ...solver.simulation.orbital_scene import ORBITAL_SENSORS, OrbitalScene, OrbitalSensor, overpass_beside
from ...solver.simulation.satellite_block import rigorous_images, scattered_points, simulate_block
from ..convert import SECOND_NS, ground_point_message
from ..errors import UserError
from ..formats.block_messages import block_messages
from ..formats.satellite.folder_writer import EPOCH, write_overpass
from ..formats.scene_block import DEFAULTS, read_scene_block, write_scene_block
from ..formats.scene_recording import local_block
from ..formats.table import Column, read_table, write_table
from ..node import Message

#: Lines longer than this are not rendered: a scene of them would take minutes.
_MOST_PIXELS = 2000
_BLOCK_LINES = 25
#: Place that is passed over, unless one is given: the first that the orbit reaches; geocentric degrees.
_PLACES = ((36.0, 139.6), (20.0, 139.6), (0.0, 139.6))
#: The outermost of several overpasses look so far aside, degrees; the next one comes so long after each.
_ASIDE_DEG, _NEXT_NS = 15.0, 3 * 86_400 * SECOND_NS
#: More overpasses than this are not asked for.
MOST_OVERPASSES = 9
#: Smallest and largest gross error, pixels.
_GROSS_PX = (5.0, 30.0)


@dataclass(frozen=True)
class SceneSimulation:
    """What to simulate.

    Attributes
    ----------
    satellite : a name of `ORBITAL_SENSORS`
    lat_deg, lon_deg : that the satellite passes over; None for a place that its orbit reaches
    overpasses : of the place; several look at it from aside, from the one side to the other
    points, control, check : number of ground points, and how many of them have known coordinates
    image_sigma_px, control_sigma_m : noise
    outliers : share of the image points of tie points that are gross errors
    seed : of the random numbers
    images : whether a recording gets image lines
    """

    satellite: str
    lat_deg: float | None = None
    lon_deg: float | None = None
    points: int = 120
    control: int = 9
    check: int = 25
    image_sigma_px: float = 0.3
    control_sigma_m: float = 0.5
    outliers: float = 0.0
    seed: int = 1
    images: bool = False
    overpasses: int = 1


def simulated_recording(what: SceneSimulation) -> tuple[list[Message], dict[str, Any]]:
    """The same as the messages of a flight, with the true points on ``truth/point``, and what they hold.

    Of a recording with image lines only ground points are measured: a matcher finds the others.

    Raises
    ------
    UserError : as `write_simulated_scenes`
    """
    with TemporaryDirectory() as scratch:
        folder = Path(scratch) / what.satellite
        result, sensors = write_with_sensors(folder, what)
        block = local_block(read_scene_block(folder))
        truth = read_table(folder / "truth.csv", (Column("point", "text"), *map(Column, ("X_m", "Y_m", "Z_m"))), [])
    xyz = block.frame.from_crs(truth.stack("X_m", "Y_m", "Z_m"))
    messages = list(block_messages(block, "simulator"))
    start = messages[0].stamp_ns
    points = [
        Message("truth/point", start, ground_point_message(id, position, np.zeros((3, 3)), "check"), "simulator")
        for id, position in zip(truth["point"], xyz, strict=True)
    ]
    after = next(
        k for k, message in enumerate(messages) if message.topic.startswith(("observation/tie", "trajectory/"))
    )
    messages = [*messages[:after], *points, *messages[after:]]
    if what.images:
        known = set(block.ground.id)
        messages = [m for m in messages if m.topic not in ("observation/tie", "truth/point") or m.body.point in known]
        lines = _image_lines(block, messages, sensors, what.seed)
        messages = list(merge(messages, lines, key=lambda message: (message.stamp_ns, rank(message.topic))))
    return messages, result


def _image_lines(
    block: BlockData, messages: Sequence[Message], sensors: Sequence[PushbroomSensor], seed: int
) -> list[Message]:
    """Blocks of image lines of all strips, through the true sensors, of ground at the height of the local frame."""
    strips = {m.body.id: m.body for m in messages if m.topic == "configuration/strip"}
    texture = texture_of(sensors[0], seed)
    found = []
    for strip, sensor in zip(block.strips, sensors, strict=True):
        ccd = strip.lens or ""
        if sensor.samples > _MOST_PIXELS:
            raise UserError(
                f"{sensor.name}: lines of {sensor.samples} pixels, wanted at most {_MOST_PIXELS} for images"
            )
        pixels = render(sensor, block.frame, texture, block.frame.height_m, np.random.default_rng([seed, len(found)]))
        period, first_ns = SECOND_NS / strip.line_rate_hz, strips[strip.id].first_line_time_ns
        for first in range(0, len(pixels), _BLOCK_LINES):
            part = pixels[first : first + _BLOCK_LINES]
            body = LineBlock(part, ccd, strip.id, first, first_ns + round(first * period), round(period))
            stamp = first_ns + round((first + len(part) - 1) * period)
            found.append(Message(f"sensor/lines/{ccd}", stamp, body, "simulator"))
    return sorted(found, key=lambda message: (message.stamp_ns, rank(message.topic)))


def write_simulated_scenes(folder: Path, what: SceneSimulation) -> dict[str, Any]:
    """Write a folder that `triline adjust` takes, with ``truth.csv``; returns what it holds.

    Raises
    ------
    UserError : a satellite that is not known or does not reach the place, numbers that do not fit together
    """
    return write_with_sensors(folder, what)[0]


def write_with_sensors(folder: Path, what: SceneSimulation) -> tuple[dict[str, Any], list[PushbroomSensor]]:
    """As `write_simulated_scenes`; the true sensors of the images beside, in the order of the images.

    Raises
    ------
    UserError : as `write_simulated_scenes`
    """
    if what.satellite not in ORBITAL_SENSORS:
        raise UserError(f"satellite {what.satellite!r}, wanted one of {', '.join(ORBITAL_SENSORS)}")
    if min(what.points, what.control, what.check) < 0 or what.control + what.check > what.points:
        raise UserError(
            f"{what.points} points with {what.control} control and {what.check} check points, wanted no more of these "
            "than there are points"
        )
    if not (what.image_sigma_px > 0 and what.control_sigma_m > 0 and 0 <= what.outliers < 0.5):
        raise UserError("noise of image points and control: wanted numbers above 0; share of outliers: 0 to 0.5")
    sensor = ORBITAL_SENSORS[what.satellite]
    if not 1 <= what.overpasses <= MOST_OVERPASSES:
        raise UserError(f"{what.overpasses} overpasses, wanted 1 to {MOST_OVERPASSES}")
    scenes = _overpasses(sensor, what)
    rng = np.random.default_rng(what.seed)
    images = rigorous_images(scenes, DgrOptions.from_settings(DEFAULTS))
    try:
        position = scattered_points(images, what.points, rng)
    except ValueError as error:
        raise UserError(f"{what.satellite}: {error}") from None
    control = range(what.control)
    check = range(what.control, what.control + what.check)
    spread = (what.control_sigma_m, what.control_sigma_m, what.control_sigma_m)
    simulated = simulate_block(
        images, position, control, check, rng, image_sigma_px=what.image_sigma_px, control_sigma_m=spread
    )
    block, layout = simulated.block, Layout.of(images)
    sensors = [image.located(simulated.values[columns]) for image, columns in zip(images, layout.columns, strict=True)]
    if what.outliers:
        rays = block.rays
        mine = rng.random(len(rays)) < what.outliers
        mine &= rays.point >= what.control + what.check
        size = rng.uniform(*_GROSS_PX, (len(rays), 2)) * rng.choice([-1.0, 1.0], (len(rays), 2)) * mine[:, None]
        block = replace(block, rays=replace(rays, line=rays.line + size[:, 0], sample=rays.sample + size[:, 1]))
        wrong = int(mine.sum())
    else:
        wrong = 0
    folder.mkdir(parents=True, exist_ok=True)
    numbers = [str(k) for k in range(1, len(scenes) + 1)] if len(scenes) > 1 else [""]
    metadata = {f"scene{number}": what.satellite + f"-{number}" * bool(number) for number in numbers}
    for k, (name, scene) in enumerate(zip(metadata.values(), scenes, strict=True)):
        write_overpass(folder / name, scene, epoch=iso_utc(parse_time(EPOCH) + k * _NEXT_NS))
    single = len(sensor.camera.lines) == 1
    names = [image.name.removeprefix("1/") for image in images]
    write_scene_block(
        folder,
        f"simulated {what.satellite}",
        {scene: {"metadata": name} for scene, name in metadata.items()},
        block,
        [scene if single else f"{scene}/{line.id}" for scene in metadata for line in sensor.camera.lines],
        image_sigma_px=what.image_sigma_px,
    )
    lat, lon, height = block.ellipsoid.geodetic(position).T
    write_table(
        folder / "truth.csv",
        {"point": block.point_ids, "X_m": np.degrees(lon), "Y_m": np.degrees(lat), "Z_m": height},
        {"X_m": ".10f", "Y_m": ".10f", "Z_m": ".4f"},
    )
    result = {
        "folder": str(folder),
        "satellite": what.satellite,
        "images": names,
        "points": what.points,
        "control": what.control,
        "check": what.check,
        "image_points": len(block.rays),
        "outliers": wrong,
        "seed": what.seed,
    }
    return result, sensors


def _overpasses(sensor: OrbitalSensor, what: SceneSimulation) -> list[OrbitalScene]:
    rolls = np.linspace(-_ASIDE_DEG, _ASIDE_DEG, what.overpasses) if what.overpasses > 1 else np.zeros(1)
    if what.lat_deg is None or what.lon_deg is None:
        lat_deg, lon_deg = next(place for place in _PLACES if place[0] < sensor.inclination_deg)
    else:
        lat_deg, lon_deg = what.lat_deg, what.lon_deg
    try:
        return [overpass_beside(sensor, lat_deg, lon_deg, roll) for roll in rolls.tolist()]
    except ValueError as error:
        raise UserError(f"--place: {error}") from None
