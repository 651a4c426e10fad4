"""Writes a block folder; `block_folder.read_block` gives the same block."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from triline.nodes.formats.camera_json import write_camera
from triline.nodes.formats.table import write_table
from triline.solver.adjustment.block_data import BlockData
from triline.solver.adjustment.network import Strip
from triline.solver.geometry.rotation import angles_from_matrix, matrix_from_quaternion


def write_block(folder: Path | str, block: BlockData) -> None:
    """Write all files of a block folder, in the CRS of the block's frame.

    Coordinates have six decimals (eleven where the CRS counts in degrees), angles nine decimals of a degree.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "project.toml").write_text(_project(block), encoding="utf-8")
    write_camera(folder / "camera.json", block.camera)
    _write_strips(folder, block)
    _write_trajectories(folder, block)
    _write_ground_points(folder, block)
    _write_image_points(folder, block)


def _project(block: BlockData) -> str:
    lines = ["[project]", f"name = {json.dumps(block.name)}", f"crs = {json.dumps(block.frame.crs)}"]
    lines += ["[apriori]", f"image_sigma_px = {block.apriori.image_sigma_px!r}"]
    if block.apriori.trajectory:
        lines.append("[trajectory]")
        lines += [f"{key} = {_toml(value)}" for key, value in block.apriori.trajectory.items()]
    if block.apriori.then:
        lines.append("[trajectory.then]")
        lines += [f"{key} = {_toml(value)}" for key, value in block.apriori.then.items()]
    return "\n".join(lines) + "\n"


def _toml(value: object) -> str:
    if isinstance(value, tuple | list):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key} = {_toml(v)}" for key, v in value.items()) + "}"
    return json.dumps(value)


def _name(strip: Strip) -> str:
    return strip.id if strip.lens is None else strip.id.removesuffix(f"/{strip.lens}")


def _write_strips(folder: Path, block: BlockData) -> None:
    strips = block.strips
    columns: dict[str, list[object]] = {
        "strip": [_name(strip) for strip in strips],
        "first_line_time_s": [strip.first_line_time_s for strip in strips],
        "line_rate_hz": [strip.line_rate_hz for strip in strips],
        "lines": [strip.lines for strip in strips],
    }
    if any(strip.lens for strip in strips):
        columns["lens"] = [strip.lens or "" for strip in strips]
    if any(strip.line_time_s is not None for strip in strips):
        columns["line_times"] = [
            "" if strip.line_time_s is None else f"lines_{i}.csv" for i, strip in enumerate(strips, 1)
        ]
        for i, strip in enumerate(strips, 1):
            if strip.line_time_s is not None:
                times = {"line": range(len(strip.line_time_s)), "time_s": strip.line_time_s}
                write_table(folder / f"lines_{i}.csv", times, {"time_s": ".9f"})
    write_table(folder / "strips.csv", columns, {"first_line_time_s": ".9f", "line_rate_hz": ".12g"})


def _write_trajectories(folder: Path, block: BlockData) -> None:
    written: dict[int, Strip] = {}  # strips that share a trajectory (lenses) write it once
    for strip in block.strips:
        written.setdefault(id(strip.trajectory), strip)
    strips = list(written.values())
    shared = {id(s.trajectory) for s in block.strips if sum(o.trajectory is s.trajectory for o in block.strips) > 1}
    own = [len(strip.trajectory) for strip in strips]
    position = np.concatenate([strip.trajectory.position_l for strip in strips])
    R = matrix_from_quaternion(np.concatenate([strip.trajectory.quaternion for strip in strips]))
    xyz = block.frame.to_crs(position)
    if block.frame.crs != "local":
        R = np.swapaxes(block.frame.R_l_crs(xyz), -1, -2) @ R
    angles = np.degrees(angles_from_matrix(R))
    columns: dict[str, object] = {
        "strip": np.repeat([_name(strip) for strip in strips], own),
        "time_s": np.concatenate([strip.trajectory.time_s for strip in strips]),
    }
    columns |= dict(zip(("X_m", "Y_m", "Z_m"), xyz.T, strict=True))
    columns |= dict(zip(("omega_deg", "phi_deg", "kappa_deg"), angles.T, strict=True))
    lens = [(strip.lens or "") if id(strip.trajectory) not in shared else "" for strip in strips]
    if any(lens):
        columns["lens"] = np.repeat(lens, own)
    formats = _place_formats(block) | {"time_s": ".9f"} | dict.fromkeys(("omega_deg", "phi_deg", "kappa_deg"), ".9f")
    write_table(folder / "trajectory.csv", columns, formats)


def _place_formats(block: BlockData) -> dict[str, str]:
    flat = ".11f" if block.frame.is_geographic else ".6f"
    return {"X_m": flat, "Y_m": flat, "Z_m": ".6f"}


def _write_ground_points(folder: Path, block: BlockData) -> None:
    ground = block.ground
    xyz = block.frame.to_crs(ground.xyz_l) if len(ground) else np.empty((0, 3))
    covariance = ground.covariance
    if block.frame.crs != "local" and len(ground):
        R = block.frame.R_l_crs(xyz)
        covariance = np.swapaxes(R, -1, -2) @ covariance @ R
    sigma = np.sqrt(np.maximum(np.einsum("nii->ni", covariance), 0.0))
    columns: dict[str, object] = {"point": ground.id}
    columns |= dict(zip(("X_m", "Y_m", "Z_m"), xyz.T, strict=True))
    columns |= dict(zip(("sigma_X_m", "sigma_Y_m", "sigma_Z_m"), sigma.T, strict=True))
    columns["role"] = ground.role
    if any(ground.target_radius_m):
        columns["target_radius_m"] = ground.target_radius_m
    formats = _place_formats(block) | dict.fromkeys(("sigma_X_m", "sigma_Y_m", "sigma_Z_m"), ".6f")
    formats["target_radius_m"] = ".6g"
    write_table(folder / "ground_points.csv", columns, formats)


def _write_image_points(folder: Path, block: BlockData) -> None:
    image = block.image
    points = np.array(block.point_ids, dtype=object)
    strips = np.array([*(_name(strip) for strip in block.strips), ""], dtype=object)
    ccds = np.array([*(line.id for line in block.camera.lines), ""], dtype=object)
    strip, ccd = strips[image.strip], ccds[image.ccd]
    for row, (strip_name, ccd_name) in image.unknown.items():
        strip[row], ccd[row] = strip_name, ccd_name
    of_sample = image.sigma_sample_px  # the format has one sigma for both
    columns = {
        "point": points[image.point],
        "strip": strip,
        "ccd": ccd,
        "line": image.line,
        "sample": image.sample,
        "sigma_px": image.sigma_px if of_sample is None else np.maximum(image.sigma_px, of_sample),
    }
    write_table(folder / "image_points.csv", columns, {"line": ".6f", "sample": ".6f", "sigma_px": ".6g"})
