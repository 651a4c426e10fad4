"""A simulated block of satellite scenes as a folder: metadata, control, image points, and the truth beside them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...solver.models.dgr import DgrOptions
from ...solver.simulation.orbital_scene import ORBITAL_SENSORS, overpass
from ...solver.simulation.satellite_block import rigorous_images, scattered_points, simulate_block
from ..errors import UserError
from ..formats.satellite.folder_writer import write_overpass
from ..formats.scene_block import write_scene_block
from ..formats.table import write_table
from .scene_adjustment import DEFAULTS

#: Smallest and largest gross error, pixels.
_GROSS_PX = (5.0, 30.0)


@dataclass(frozen=True)
class SceneSimulation:
    """What to simulate.

    Attributes
    ----------
    satellite : a name of `ORBITAL_SENSORS`
    lat_deg, lon_deg : that the satellite passes over
    points, control, check : number of ground points, and how many of them have known coordinates
    image_sigma_px, control_sigma_m : noise
    outliers : share of the image points of tie points that are gross errors
    seed : of the random numbers
    """

    satellite: str
    lat_deg: float = 36.0
    lon_deg: float = 139.6
    points: int = 120
    control: int = 9
    check: int = 25
    image_sigma_px: float = 0.3
    control_sigma_m: float = 0.5
    outliers: float = 0.0
    seed: int = 1


def write_simulated_scenes(folder: Path, what: SceneSimulation) -> dict[str, Any]:
    """Write a folder that `triline adjust` takes, with ``truth.csv``; returns what it holds.

    Raises
    ------
    UserError : a satellite that is not known or does not reach the place, numbers that do not fit together
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
    try:
        scene = overpass(sensor, what.lat_deg, what.lon_deg)
    except ValueError as error:
        raise UserError(str(error)) from None
    rng = np.random.default_rng(what.seed)
    images = rigorous_images([scene], DgrOptions.from_settings(DEFAULTS))
    try:
        position = scattered_points(images, what.points, rng)
    except ValueError as error:
        raise UserError(f"{what.satellite}: {error}") from None
    control = range(what.control)
    check = range(what.control, what.control + what.check)
    spread = (what.control_sigma_m, what.control_sigma_m, what.control_sigma_m)
    block = simulate_block(
        images, position, control, check, rng, image_sigma_px=what.image_sigma_px, control_sigma_m=spread
    ).block
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
    write_overpass(folder / what.satellite, scene)
    single = len(images) == 1
    names = [image.name.removeprefix("1/") for image in images]
    write_scene_block(
        folder,
        f"simulated {what.satellite}",
        {"scene": {"metadata": what.satellite}},
        block,
        ["scene" if single else f"scene/{name}" for name in names],
        image_sigma_px=what.image_sigma_px,
    )
    lat, lon, height = block.ellipsoid.geodetic(position).T
    write_table(
        folder / "truth.csv",
        {"point": block.point_ids, "X_m": np.degrees(lon), "Y_m": np.degrees(lat), "Z_m": height},
        {"X_m": ".10f", "Y_m": ".10f", "Z_m": ".4f"},
    )
    return {
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
