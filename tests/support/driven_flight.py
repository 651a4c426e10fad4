"""A small simulated flight as somebody's drivers would have it: a flight folder and plain files, none of them ours."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyproj

from triline.nodes.convert import camera_from, local_frame, time_ns
from triline.nodes.formats.camera_json import write_camera
from triline.nodes.simulator.flight_settings import simulated_flight
from triline.nodes.simulator.simulator import Simulator

CRS = "EPSG:32632"
SETTINGS = {
    "sensor": "ads40-small", "pixels": 200, "images": True, "seconds": 8.0, "height": 300.0, "relief": 20.0,
    "lead_in": 3.0, "lead_out": 0.5, "attitude_rate": 50.0, "control": 4, "check": 0, "seed": 3,
}  # fmt: skip
TOML = """
[flight]
name = "driven"
platform = "driven"
crs = "{crs}"
vertical_datum = "ellipsoid"
[camera]
file = "camera.json"
[mounting]
lever_arm_m = {lever_arm}
camera_lever_arm_m = [0.0, 0.0, 0.0]
boresight_deg = {boresight}
[navigation]
gnss = "code"
imu = "tactical"
[control]
file = "control.csv"
"""


def write_flight(folder: Path, **settings) -> dict[str, int]:
    """``folder/flight`` (flight.toml, camera, control) and ``folder/drivers``; the number of messages by topic."""
    flight, drivers = folder / "flight", folder / "drivers"
    flight.mkdir(parents=True)
    drivers.mkdir()
    flown = simulated_flight({**SETTINGS, **settings})
    rows: dict[str, list] = {"gnss": [], "imu": [], "attitude": [], "control": []}
    blocks: dict[str, list] = {}
    counts: dict[str, int] = {}
    first_s, rate = 0.0, 1.0
    for message in Simulator(flown.simulation, flown.imager).messages(0):
        topic, body = message.topic, message.body
        seconds = message.stamp_ns * 1e-9
        counts[topic] = counts.get(topic, 0) + 1
        if topic == "configuration/project":
            frame = local_frame(body)
            text = TOML.format(crs=CRS, lever_arm=list(body.lever_arm_m), boresight=list(body.boresight_deg))
            (flight / "flight.toml").write_text(text)
        elif topic == "configuration/camera":
            write_camera(flight / "camera.json", camera_from(body))
        elif topic == "configuration/strip":
            first_s, rate = body.first_line_time_ns * 1e-9, body.line_rate_hz
        elif topic == "sensor/gnss":
            sigma = np.sqrt(body.position_covariance[0])
            rows["gnss"].append([time_ns(body.timestamp) * 1e-9, body.latitude, body.longitude, body.altitude, sigma])
        elif topic == "sensor/imu":
            b = body
            values = [b.force_x, b.force_y, b.force_z, b.rate_x, b.rate_y, b.rate_z]
            rows["imu"].append([seconds, b.interval_ns * 1e-9, *values])
        elif topic == "sensor/attitude":
            sigma = np.sqrt(body.covariance[0])
            rows["attitude"].append([seconds, body.roll, body.pitch, body.heading, sigma])
        elif topic == "observation/control":
            lat, lon, height = frame.to_geodetic([body.x, body.y, body.z])
            rows["control"].append([body.point, lat, lon, height])
        elif topic.startswith("sensor/lines/"):
            blocks.setdefault(body.ccd, []).append(body.pixels)
    for name in ("gnss", "imu", "attitude"):
        if rows[name]:
            np.savetxt(drivers / f"{name}.csv", rows[name], "%.10f", ",", header="see publish_sensors.py")
    for ccd, parts in blocks.items():
        np.save(drivers / f"lines_{ccd}.npy", np.concatenate(parts))
    (drivers / "lines.csv").write_text(f"first_time_s,rate_hz\n{first_s:.9f},{rate:.9f}\n")
    to_utm = pyproj.Transformer.from_crs("EPSG:4979", CRS, always_xy=True)
    lines = ["point,X_m,Y_m,Z_m,sigma_X_m,sigma_Y_m,sigma_Z_m,role"]
    for point, lat, lon, height in rows["control"]:
        x, y, z = to_utm.transform(lon, lat, height)
        lines.append(f"{point},{x:.4f},{y:.4f},{z:.4f},0.05,0.05,0.08,control")
    (flight / "control.csv").write_text("\n".join(lines) + "\n")
    return {**counts, "blocks": json.loads(json.dumps({ccd: len(parts) for ccd, parts in blocks.items()}))}


def write_rows(drivers: Path, path: Path) -> int:
    """The folder ``drivers`` as rows for the standard input of publish_sensors.c; the number of rows."""
    rows: list[tuple[int, str, bytes]] = []  # when it is known, ns; text; pixels
    for kind in ("gnss", "imu", "attitude"):
        if (drivers / f"{kind}.csv").exists():
            for time_s, *values in np.loadtxt(drivers / f"{kind}.csv", delimiter=",", ndmin=2).tolist():
                t = round(time_s * 1e9)
                whole = [str(round(values.pop(0) * 1e9))] if kind == "imu" else []
                rows.append((t, " ".join([kind, str(t), *whole, *map(repr, values)]), b""))
    first_s, rate = np.loadtxt(drivers / "lines.csv", delimiter=",", skiprows=1).tolist()
    period, size = round(1e9 / rate), max(round(rate / 10), 1)
    for image in sorted(drivers.glob("lines_*.npy")):
        pixels = np.load(image)
        for n in range(0, len(pixels), size):
            block = pixels[n : n + size]
            t = round(first_s * 1e9) + n * period
            text = f"lines {t} {image.stem[6:]} {n} {period} {len(block)} {block.shape[1]} {8 * block.itemsize}"
            rows.append((t + (len(block) - 1) * period, text, block.tobytes()))
    rows.sort(key=lambda row: row[0])
    path.write_bytes(b"".join(f"{text}\n".encode() + data for _, text, data in rows))
    return len(rows)
