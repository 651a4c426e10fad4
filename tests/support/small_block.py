"""A small block with known answers, written by hand into a block folder."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from triline.solver.adjustment.block_data import Apriori, BlockData, ImagePoints, KnownPoints
from triline.solver.adjustment.network import Strip
from triline.solver.camera.collinearity import project
from triline.solver.camera.sensors import preset
from triline.solver.geometry.frames import LocalFrame
from triline.solver.geometry.rotation import matrix_from_angles, quaternion_from_matrix
from triline.solver.geometry.trajectory import Trajectory

CAMERA = {
    "name": "test",
    "lenses": [{"id": "L1", "focal_length_mm": 60.0, "principal_point_mm": [0.01, -0.02]}],
    "lines": [
        {"id": "F", "lens": "L1", "pixels": 1000, "pixel_size_mm": 0.01, "center_mm": [25.0, 0.0]},
        {
            "id": "N",
            "lens": "L1",
            "pixels": 1000,
            "pixel_size_mm": 0.01,
            "center_mm": [0.0, 0.0],
            "inclination_deg": 1.0,
        },
    ],
}
FILES = {
    "project.toml": '[project]\nname = "hand"\ncrs = "local"\n[apriori]\nimage_sigma_px = 0.4\n'
    "[trajectory]\noffset_sigma_m = [0.1, 0.2, 0.3]\n",
    "camera.json": json.dumps(CAMERA),
    "strips.csv": "strip,first_line_time_s,line_rate_hz,lines\nS1,100.0,200.0,2001\n",
    "trajectory.csv": "strip,time_s,X_m,Y_m,Z_m,omega_deg,phi_deg,kappa_deg\n"
    + "".join(f"S1,{99 + i},{70 * i}.0,1.5,1000.0,0.1,-0.2,{0.5 + 0.01 * i}\n" for i in range(13)),
    "ground_points.csv": "point,X_m,Y_m,Z_m,sigma_X_m,sigma_Y_m,sigma_Z_m,role\n"
    "G1,300,20,100,0.02,0.03,0.04,control\nG2,350,-20,,0.02,0.02,,planimetric\n"
    "G3,400,0,110,,,0.05,height\nG4,410,5,111,,,,check\n",
    "image_points.csv": "point,strip,ccd,line,sample,sigma_px\nG1,S1,F,500.25,499.5,0.5\nG1,S1,N,900,510,\n"
    "T1,S1,N,901,10,\n",
}


TRAJECTORY_ROWS = FILES["trajectory.csv"].splitlines()


def write_files(folder: Path, **changed: str | None) -> Path:
    """Write the folder; ``image_points='...'`` replaces that file (None leaves it out)."""
    folder.mkdir(exist_ok=True)
    for name, text in FILES.items():
        text = changed.get(name.split(".")[0], text)
        if text is not None:
            (folder / name).write_text(text, encoding="utf-8")
    return folder


def simulated_block(crs: str = "local", lat_deg: float = 47.5, lon_deg: float = 10.6) -> BlockData:
    """Two strips of the ADS40 over 12 points, exact image points; times of the strips overlap."""
    rng = np.random.default_rng(5)
    camera = preset("ads40")
    frame = LocalFrame(0.0, 0.0, 0.0) if crs == "local" else LocalFrame(lat_deg, lon_deg, 0.0, crs)
    ground = np.column_stack([rng.uniform(-200, 200, 12), rng.uniform(-400, 400, 12), rng.uniform(90, 130, 12)])
    strips = []
    for id, start, across in (("S1", 10.0, -100.0), ("S2", 15.0, 100.0)):
        t = start + np.arange(0.0, 24.0, 0.1)
        position = np.column_stack([(t - start - 13) * 60.0, np.full(len(t), across), np.full(len(t), 1200.0)])
        angles = np.radians(np.column_stack([np.sin(t) * 0.2, np.cos(t) * 0.1, 0.3 + 0.1 * np.sin(0.7 * t)]))
        R = matrix_from_angles(*angles.T)
        strips.append(Strip(id, Trajectory(t, position, quaternion_from_matrix(R)), start + 0.25, 400.0, 9400))
    point, strip, ccd, line, sample = [], [], [], [], []
    for s, one in enumerate(strips):
        u = np.arange(0.0, one.lines, 4.0)
        pose = one.trajectory.at(one.time_of(u))
        for p, xyz in enumerate(ground):
            image = project(pose.position_l, pose.angles, np.tile(xyz, (len(u), 1)), np.full(len(u), 62.7)).xy_mm
            for c, ccd_line in enumerate(camera.lines):
                x = image[:, 0] - ccd_line.xy_mm[0, 0]
                k = int(np.flatnonzero(np.diff(np.sign(x)))[0])
                share = x[k] / (x[k] - x[k + 1])
                y = image[k, 1] + share * (image[k + 1, 1] - image[k, 1])
                v = (y - ccd_line.xy_mm[0, 1]) / 0.0065
                if 0 <= v < ccd_line.pixels:
                    point.append(p), strip.append(s), ccd.append(c), line.append(u[k] + 4 * share), sample.append(v)
    time = [strips[s].time_of(u) for s, u in zip(strip, line, strict=True)]
    role = tuple(["control"] * 3 + ["planimetric", "height"] + ["check"] * 3)
    sigma = [0.02, 0.03, 0.04] if crs == "local" else [0.03] * 3  # files hold no correlations
    covariance = np.tile(np.diag(sigma) ** 2, (8, 1, 1))
    ids = tuple(f"P{i}" for i in range(12))
    image = ImagePoints(
        np.array(point), np.array(strip), np.array(ccd), np.array(line), np.array(sample), np.full(len(line), 0.3),
        np.array(time),
    )  # fmt: skip
    apriori = Apriori(0.3, {"offset_sigma_m": (0.1, 0.1, 0.2), "shift_sigma_deg": (0.01, 0.01, 0.02)})
    return BlockData(
        "small", frame, camera, tuple(strips), ids, KnownPoints(ids[:8], ground[:8], covariance, role), image, apriori
    )
