"""Rows of the published tables, and the networks they came from: [K] Tables 5.3 to 5.26, [P] 4.1 and 4.2.

Figures are those of the publications. What they leave unsaid is assumed here and told in each network's `unsaid`:
everywhere the places of points (at random over the area) and of control (well spread), and the heights of the ground.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..camera.line_camera import LineCamera
from ..camera.self_calibration import SelfCalibration, lens, prism
from ..models.base import same
from ..models.dgr import DgrOptions
from ..models.lim import LimOptions
from ..models.ppm import PpmOptions
from .published_network import AerialNetwork, PublishedNetwork, PublishedRow, SceneNetwork
from .testfields import Published, pavia, vaihingen, yoriichio_si100, yoriichio_si290

#: Images of a PRISM triplet are 35 km wide: the middle of the 19 872 samples that four chips have.
_PRISM_MARGIN_PX = (50.0, 2950.0)
#: Weights of continuity are called "relatively high" [K 4.2.3]: a tenth of a pixel on the ground, at once and a second.
_CONTINUITY_M, _CONTINUITY_DEG = same(0.1), same(1e-5)


def six_of_prism(camera: LineCamera) -> SelfCalibration:
    """Scale and bending of every line, free; shifts of chips are fixed [K 5.3.2.1]."""
    full = prism(camera)
    return full.without([name for name in full.names if name.startswith(("dx", "dy"))]).free()


def four_of_hrs(camera: LineCamera) -> SelfCalibration:
    """k1, k2, p2 and sy of every lens [P 4.1]."""
    full = lens(camera)
    return full.without([name for name in full.names if name.split("_")[0] not in ("k1", "k2", "p2", "sy")])


def _ppm(segments: int, shift_deg: float, first_deg: float, second_deg: float, continuity: int = 1) -> PpmOptions:
    """Piecewise polynomials with the position weights of Tables 5.17 and 5.25, which are the same."""
    return PpmOptions(
        segments,
        continuity=continuity,
        offset_sigma_m=same(2.0),
        shift_sigma_deg=same(shift_deg),
        first_sigma_m=same(1.0),
        first_sigma_deg=same(first_deg),
        second_sigma_m=same(0.5),
        second_sigma_deg=same(second_deg),
        continuity_sigma_m=_CONTINUITY_M,
        continuity_sigma_deg=_CONTINUITY_DEG,
    )


#: Table 5.17: nothing was known of the attitude.
_DGR_UNKNOWN = DgrOptions(same(2.0), same(2.0), same(0.5))
#: Table 5.25.
_DGR_ZURICH = DgrOptions(same(2.0), same(0.07), same(1e-4))


def _unknown(segments: int) -> PpmOptions:
    return _ppm(segments, 2.0, 0.5, 0.01)


def _prism_rows(
    known: int, table: tuple[tuple[str, int, float, float, float, float, float], ...], dgr: DgrOptions,
    ppm: PpmOptions,
) -> tuple[PublishedRow, ...]:  # fmt: skip
    """Rows (label, control, RMSE XY, Z, sigma XY, Z, sigma0) with image points of 0.5 px."""
    return tuple(
        PublishedRow(
            label, ppm if label.startswith("PPM") else dgr, control, known - control,
            Published(rmse_xy, rmse_z, sigma_xy, sigma_z, (sigma0, sigma0)), 0.5, sigma0,
        )
        for label, control, rmse_xy, rmse_z, sigma_xy, sigma_z, sigma0 in table
    )  # fmt: skip


def _prism(
    key: str, name: str, place: tuple[float, float], known: int, tie: int, height_m: tuple[float, float],
    control_m: float, rows: tuple[PublishedRow, ...], unsaid: str,
) -> SceneNetwork:  # fmt: skip
    return SceneNetwork(
        key, name, "alos-prism", *place, known, tie, height_m, _PRISM_MARGIN_PX, control_m, six_of_prism, rows, unsaid
    )


def saitama() -> PublishedNetwork:
    """Tables 5.16 to 5.18."""
    rows = _prism_rows(203, (
        ("DGR SC", 5, 1.38, 2.46, 0.79, 2.10, 0.39),
        ("PPM-2 SC", 5, 2.10, 2.77, 1.52, 2.76, 0.37),
        ("DGR SC", 9, 1.24, 2.13, 0.74, 1.98, 0.39),
        ("PPM-2 SC", 9, 1.25, 2.33, 0.86, 2.18, 0.37),
        ("DGR SC", 25, 1.24, 2.00, 0.71, 1.92, 0.41),
        ("PPM-2 SC", 25, 1.34, 2.30, 0.70, 1.89, 0.38),
    ), _DGR_UNKNOWN, _unknown(2))  # fmt: skip
    return _prism(
        "saitama", "PRISM Saitama", (35.9, 139.5), 203, 111, (0.0, 300.0), 0.5, rows,
        "Unsaid: which points were control (many lie in close groups; here they are spread), and the weights of "
        "continuity between segments.",
    )  # fmt: skip


def bern() -> PublishedNetwork:
    """Tables 5.19 and 5.20, weights of Table 5.17."""
    rows = _prism_rows(108, (
        ("DGR SC", 5, 2.23, 1.77, 0.82, 2.09, 0.38),
        ("PPM-2 SC", 5, 4.35, 5.24, 2.52, 6.51, 0.39),
        ("DGR SC", 9, 1.97, 1.57, 0.75, 2.01, 0.39),
        ("PPM-2 SC", 9, 3.47, 3.30, 0.99, 2.62, 0.41),
        ("DGR SC", 25, 1.80, 1.46, 0.89, 2.43, 0.51),
        ("PPM-2 SC", 25, 1.93, 3.21, 1.01, 2.77, 0.55),
    ), _DGR_UNKNOWN, _unknown(2))  # fmt: skip
    return _prism(
        "bern", "PRISM Bern/Thun", (46.85, 7.5), 108, 24, (450.0, 1500.0), 0.5, rows,
        "Unsaid: sigma of the control points (\"similar to Saitama\": 0.5 m here) and how much of the scene they "
        "cover (all of it here).",
    )  # fmt: skip


def piemont() -> PublishedNetwork:
    """Tables 5.21 and 5.22, weights of Table 5.17."""
    rows = _prism_rows(29, (
        ("DGR SC", 5, 2.34, 1.05, 0.58, 1.60, 0.28),
        ("PPM-2 SC", 5, 2.58, 2.36, 2.37, 4.10, 0.26),
        ("DGR SC", 9, 2.22, 1.03, 0.59, 1.64, 0.30),
        ("PPM-2 SC", 9, 2.20, 1.20, 0.68, 1.82, 0.27),
    ), _DGR_UNKNOWN, _unknown(2))  # fmt: skip
    return _prism(
        "piemont", "PRISM Piemont", (45.0, 7.4), 29, 142, (300.0, 2500.0), 0.5, rows,
        "Unsaid: sigma of the control points (0.5 m here); the mountains kept control from being spread well, here "
        "it is.",
    )  # fmt: skip


def okazaki() -> PublishedNetwork:
    """Table 5.23, weights of Table 5.17; the figure with the results is lost.

    Sigmas of 25 control points are the extremes of Table 5.27, which no other testfield reaches.
    """
    nothing = np.nan
    rows = _prism_rows(51, (
        ("DGR SC", 5, nothing, nothing, nothing, nothing, 0.525),
        ("DGR SC", 9, nothing, nothing, nothing, nothing, 0.525),
        ("DGR SC", 25, nothing, nothing, 0.94, 2.60, 0.525),
        ("PPM-1 SC", 25, nothing, nothing, nothing, nothing, 0.525),
    ), _DGR_UNKNOWN, _unknown(1))  # fmt: skip
    return _prism(
        "okazaki", "PRISM Okazaki", (34.95, 137.2), 51, 135, (0.0, 800.0), 0.5, rows,
        "Unsaid: all results but sigma0 (0.51 to 0.54 px; its figure is lost) and the largest sigmas of Table 5.27, "
        "which no other testfield has.",
    )  # fmt: skip


def zurich() -> PublishedNetwork:
    """Tables 5.24 to 5.26."""
    rows = _prism_rows(99, (
        ("DGR SC", 1, 3.23, 7.68, 2.45, 11.08, 0.30),
        ("DGR SC", 2, 1.60, 0.89, 0.70, 1.92, 0.30),
        ("DGR SC", 4, 1.36, 0.85, 0.62, 1.69, 0.30),
        ("DGR SC", 9, 1.34, 0.91, 0.55, 1.50, 0.30),
        ("PPM-1 SC", 9, 1.34, 0.91, 0.55, 1.50, 0.31),
    ), _DGR_ZURICH, _ppm(1, 0.07, 1e-4, 1e-5))  # fmt: skip
    return _prism(
        "zurich", "PRISM Zurich/Winterthur", (47.45, 8.65), 99, 101, (350.0, 900.0), 0.2, rows,
        "Unsaid: which points were control and what held the scales with one of them, which they leave free (six "
        "free parameters here, four significant ones there).",
    )  # fmt: skip


def hrs() -> PublishedNetwork:
    """SPOT-5/HRS [P 4.1], with the configuration and figures of [K 1.4.2]."""
    row = PublishedRow(
        "PPM-2 SC", _ppm(2, 2.0, 0.5, 0.01, continuity=2), 16, 25,
        Published(float(np.hypot(3.5, 6.2) / np.sqrt(2.0)), 3.8), 0.5, 0.5,
    )  # fmt: skip
    return SceneNetwork(
        "hrs", "SPOT-5/HRS (X 3.5, Y 6.2, Z 3.8 m published)", "spot5-hrs", 47.8, 12.6, 41, 0, (400.0, 2000.0),
        (50.0, 50.0), 1.0, four_of_hrs, (row,),
        "Unsaid: image measurement (0.5 px here), sigma of control (1 m), weights (those of Saitama), the place; its "
        "pixels are built 5 m along and 10 m across the track, as the sensor's are, not the other way round.",
    )  # fmt: skip


def aster() -> PublishedNetwork:
    """ASTER VNIR 3N and 3B of Shaxi [P 4.2]: six control points, differences at these points."""
    row = PublishedRow(
        "PPM-1", _unknown(1), 6, 0, Published(float(np.hypot(8.1, 8.4) / np.sqrt(2.0)), 10.4), 0.5, 0.5, False
    )
    return SceneNetwork(
        "aster", "ASTER Shaxi, at control (X 8.1, Y 8.4, Z 10.4 m published)", "aster-vnir", 26.3, 99.85, 6, 0,
        (2000.0, 3500.0), (50.0, 50.0), 5.0, None, (row,),
        "Unsaid: segments (one here), image measurement (0.5 px), sigma of control from GPS and maps (5 m), weights "
        "(Saitama's); differences are taken as intersections of the adjusted rays minus given coordinates.",
        of_control=True,
    )  # fmt: skip


#: Table 5.4: test and its control points; XY and Z of sigma, XY and Z of RMSE, cm, of DGR and of LIM-45.
_TABLE_5_4: tuple[tuple[str, int, tuple[int, ...], tuple[int, ...]], ...] = (
    ("T.3-1", 3, (22, 67, 43, 107), (16, 47, 15, 46)),
    ("T.3-2", 3, (22, 67, 47, 81), (16, 47, 16, 47)),
    ("T.4", 4, (22, 66, 44, 99), (14, 45, 16, 47)),
    ("T.6-1", 6, (21, 64, 44, 72), (11, 40, 16, 43)),
    ("T.6-2", 6, (21, 64, 45, 88), (12, 41, 15, 36)),
    ("T.8-1", 8, (20, 63, 40, 80), (10, 36, 14, 32)),
    ("T.12", 12, (20, 62, 33, 78), (9, 33, 12, 25)),
    ("T.20", 20, (19, 61, 33, 58), (8, 28, 12, 21)),
)


def si290() -> PublishedNetwork:
    """SI-290 Yoriichio, four strips: Tables 5.2 to 5.4."""
    dgr = DgrOptions((20.0, 20.0, 5.0), (0.2, 0.2, 3.0), same(0.2))
    lim = LimOptions(45, True, same(2.0), same(0.1))
    of_dgr = [(f"DGR {test}", dgr, control, cm, 2.65) for test, control, cm, _ in _TABLE_5_4]
    of_lim = [(f"LIM-45 {test}", lim, control, cm, 1.0) for test, control, _, cm in _TABLE_5_4]
    rows = []
    for label, model, control, cm, sigma0 in (*of_dgr, *of_lim):
        sigma_xy, sigma_z, rmse_xy, rmse_z = (value / 100.0 for value in cm)
        published = Published(rmse_xy, rmse_z, sigma_xy, sigma_z)
        rows.append(PublishedRow(label, model, control, 39 - control, published, sigma0, sigma0, False))
    return AerialNetwork(
        yoriichio_si290(), tuple(rows),
        "Unsaid: sigma0 of DGR (2.65 px here, which the simulated measurements have; of LIM about 1 px), which points "
        "were control, how many images a tie point was found in (all that see it here).",
    )  # fmt: skip


def si100() -> PublishedNetwork:
    """SI-100 Yoriichio: Tables 5.7 and 5.8."""
    lim = LimOptions(30, True, (1.2, 1.2, 1.0), same(0.1))
    return AerialNetwork(
        yoriichio_si100(), (PublishedRow("LIM-30 SC", lim, 30, 31, Published(0.07, 0.14), 1.0, 1.0),),
        "Unsaid: additional parameters that were left (all 18 here), and the theoretical sigma, whose figure is lost.",
    )  # fmt: skip


def vaihingen_rows() -> PublishedNetwork:
    """ADS40 Vaihingen/Enz: Tables 5.10 and 5.11, with and without control."""
    field = vaihingen()
    model = field.errors
    without = Published(float(np.hypot(0.145, 0.047) / np.sqrt(2.0)), 0.152)
    rows = (
        PublishedRow("direct georeferencing", model, 0, 201, Published(0.125, 0.18), 0.18, 0.18, False, False),
        PublishedRow("DGR", model, 0, 201, without, 0.18, 0.18, False),
        PublishedRow("DGR", model, 4, 197, Published(0.048, 0.064), 0.18, 0.18, False),
        PublishedRow("DGR SC", model, 4, 197, Published(0.033, 0.058), 0.18, 0.18),
    )
    return AerialNetwork(
        field, rows,
        "Unsaid: sigmas (figures are lost), sigma0 without additional parameters (that with them here), how six "
        "strips lie (four and two across); without control X 14.5, Y 4.7, Z 15.2 cm are published.",
    )  # fmt: skip


def _pavia_rows(height_m: float, table: tuple[tuple[str, int, float, float], ...], unsaid: str) -> PublishedNetwork:
    field = pavia(height_m)
    direct = field.configurations[0].published
    model, sigma0, image = field.errors, field.noise.image_px, 1.0 / 3.0
    rows = [PublishedRow("direct georeferencing", model, 0, field.signalised, direct, image, image, False, False)]
    for label, control, xy, z in table:
        published = Published(xy, z)
        rows.append(
            PublishedRow(
                label, model, control, field.signalised - control, published, image, sigma0, label.endswith("SC")
            )
        )
    return AerialNetwork(field, tuple(rows), unsaid)


def pavia2000() -> PublishedNetwork:
    """ADS40 Pavia, 2000 m: Tables 5.12 to 5.14."""
    return _pavia_rows(
        2000.0, (("DGR SC", 12, 0.04, 0.05),),
        "Unsaid: which of the seven strips, additional parameters that were left (all 18 here); sigma0 is the middle "
        "of the published range.",
    )  # fmt: skip


def pavia4000() -> PublishedNetwork:
    """ADS40 Pavia, 4000 m: Tables 5.12 to 5.14."""
    return _pavia_rows(
        4000.0, (("DGR", 5, 0.351, 0.838), ("DGR SC", 5, 0.08, 0.12), ("DGR SC", 12, 0.082, 0.135)),
        "Unsaid: as at 2000 m; DGR without and with 12 control points are the middles of published ranges (0.8-1.0 "
        "and 1.9-2.4 px; 0.18-0.24 and 0.31-0.38 px).",
    )  # fmt: skip


#: Networks by key, made when they are asked for.
NETWORKS: dict[str, Callable[[], PublishedNetwork]] = {
    "hrs": hrs,
    "aster": aster,
    "saitama": saitama,
    "bern": bern,
    "piemont": piemont,
    "okazaki": okazaki,
    "zurich": zurich,
    "si290": si290,
    "si100": si100,
    "vaihingen": vaihingen_rows,
    "pavia2000": pavia2000,
    "pavia4000": pavia4000,
}
