"""The colours of CCD lines: nine that can be told apart."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from notebook import Notebook
from synthetic_flight import START_NS

from triline.nodes.convert import PoseSample
from triline.nodes.viewer.scene_part import CCD_COLORS, LIVE, REJECTED, ccd_color
from triline.nodes.viewer.scene_state import SceneState
from triline.nodes.viewer.trajectories import FlightPart
from triline.solver.camera.line_camera import Lens, LineCamera, straight_line

GROUND = (18, 20, 26, 255)
#: What the eye makes of linear red, green and blue; of the colour-blind after Machado, Oliveira and Fernandes (2009).
EYES = {
    "normal": np.eye(3),
    "protan": np.array([[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
                        [-0.003882, -0.048116, 1.051998]]),
    "deutan": np.array([[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
                        [-0.011820, 0.042940, 0.968881]]),
}  # fmt: skip
TO_XYZ = np.array([[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750],
                   [0.0193339, 0.1191920, 0.9503041]])  # fmt: skip


def lab(color, eye):
    """CIELAB of a colour, white of D65."""
    c = np.array(color[:3]) / 255.0
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    xyz = TO_XYZ @ np.clip(EYES[eye] @ linear, 0.0, 1.0) / [0.95047, 1.0, 1.08883]
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def distance(a, b, eye):
    return float(np.linalg.norm(lab(a, eye) - lab(b, eye)))


def test_the_first_four_are_those_of_before():
    assert CCD_COLORS[:4] == ((255, 140, 120, 255), (235, 225, 140, 255), (130, 170, 255, 255), (190, 140, 255, 255))


@pytest.mark.parametrize("eye", EYES)
def test_nine_can_be_told_apart(eye):
    assert len(CCD_COLORS) == 9
    for one, other in combinations(range(9), 2):
        if other >= 4 or eye == "normal":
            assert distance(CCD_COLORS[one], CCD_COLORS[other], eye) > 25.0, (one, other)
    for color in CCD_COLORS[4:]:
        assert min(distance(color, beside, eye) for beside in (LIVE, REJECTED, GROUND)) > 20.0, color


def test_the_looks_of_a_camera_like_misr_have_nine_colours():
    """The fifth CCD line had the colour of the first."""
    state, canvas = SceneState(), Notebook()
    names = "DCBANabcd"
    lines = tuple(straight_line(name, name, 100, 0.02, (0.0, 0.0)) for name in names)
    state.camera = LineCamera("nine", tuple(Lens(name, 60.0) for name in names), lines)
    sample = PoseSample(START_NS, np.array([0.0, 0.0, 1500.0]), np.array([0.0, 0.0, 0.0, 1.0]), None, True)
    state.newest = sample
    part = FlightPart(state)
    part.pose("trajectory", sample)
    part.draw(canvas)
    assert canvas.names["flight/looks"] == list(names)
    assert len(set(canvas.drawn["flight/looks"][1])) == 9 and ccd_color(9) == ccd_color(0)
