"""Additional parameters of self-calibration: TLS-18 [K 4.43], PRISM-30 [K 4.44], lens set [P], boresight, focal length.

``Dx, Dy`` are added to the projection: residual = measured - (projection + D). They are functions of the image
coordinates, reduced to the principal point, and linear in the unknowns. Measured coordinates carry noise, on which the
parameters must not act: an adjustment takes them where the ray meets its CCD line by what is known of it
(`adjustment.linearisation.fit_rays`). Units: millimetres for lengths, radians for angles, powers of mm for distortion.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from .line_camera import LineCamera

Array = NDArray[np.floating]

#: Default a-priori sigmas by kind: about 0.1 mm at the edge of an airborne sensor's image.
SIGMA = {
    "dc": 0.1,
    "k1": 1e-5,
    "k2": 1e-8,
    "k3": 1e-11,
    "p1": 1e-4,
    "p2": 1e-4,
    "xp": 0.1,
    "yp": 0.1,
    "dx": 0.1,
    "dy": 0.1,
    "sy": 1e-2,
    "s": 1e-2,
    "th": 1e-2,
    "b": 1e-5,
    "boresight": 2e-3,
}

_UNITS = dict.fromkeys(("dc", "xp", "yp", "dx", "dy"), "mm") | {
    "k1": "mm^-2", "k2": "mm^-4", "k3": "mm^-6", "p1": "mm^-1", "p2": "mm^-1", "b": "mm^-2",
    "th": "rad", "boresight": "rad",
}  # fmt: skip

#: Default a-priori sigmas of the PRISM set: 0.02 mm, about three pixels, at the end of a line of 100 mm.
PRISM_SIGMA = {"dx": 0.02, "dy": 0.02, "b": 2e-7, "s": 4e-4}

#: Name of the set of what a calibration leaves open.
LEFT = "calibrated"

#: What is usually known of a camera constant, mm: about two pixels of an airborne sensor. Tuned: half of it makes the
#: height of the camera 0.1 m too sure at 1500 m where the constant is 20 um off, twice of it changes no point.
FOCAL_SIGMA = 0.012

#: What a calibration leaves open of all else, as a share of the default sigmas: a tenth of a pixel at the edge, about.
#: Tuned: as they are questioned, cameras that are worse are followed with eight times as much or as little; where most
#: points have two looks, three times as much makes those of a camera as calibrated 6 % worse, not 3.
LEFT_OPEN = 0.0004

#: An a-priori sigma that leaves a parameter free, times its default, and one that fixes it.
FREE, FIXED = 1e4, 1e-9

_TLS_COMMON = ("dc", "k1", "k2", "k3", "p1", "p2")
_TLS_LINE = ("xp", "yp", "sy", "th")
_LENS = ("dx", "dy", "dc", "k1", "k2", "p1", "p2", "sy", "th")
_PRISM = ("dx", "dy", "b", "s")
_TURNS = ("turn_x", "turn_y", "turn_z")


@dataclass(frozen=True)
class CameraDesign:
    """Effect of additional parameters on n rays: ``D[c, i] = sum_s coefficients[c, s, i] ap[columns[pattern[i], s]]``.

    Attributes
    ----------
    pattern : (n,) which row of `columns` a ray uses
    columns : (patterns, slots) int32 index of the parameter; -1 where it is not estimated
    kinds : (slots) of parameter
    xy_mm : (2, n) image coordinates at which the parameters act
    focal_length_mm : (n,)

    Coefficients are ten times as many as the coordinates that they follow from, and made where they are wanted.
    """

    pattern: NDArray[np.int64]
    columns: NDArray[np.int32]
    kinds: tuple[str, ...] = field(repr=False)
    xy_mm: Array = field(repr=False)
    focal_length_mm: Array = field(repr=False)

    def evaluate(self, values: Array, rays: slice = slice(None)) -> Array:
        """Image displacement D (2, n) in mm for parameter values (n_unknowns,), of all rays or a range of them."""
        if not values.any():
            return np.zeros(self.xy_mm[:, rays].shape)
        return np.einsum("csn,sn->cn", self.coefficients(rays), self.values_of(values, rays))

    def values_of(self, values: Array, rays: slice = slice(None)) -> Array:
        """Those of the parameter values (n_unknowns,) that act on each ray: (slots, n)."""
        padded = np.zeros(len(values) + 1)  # at the end what does not act
        padded[:-1] = values
        of_slot = np.ascontiguousarray(padded[self.columns].T)  # (slots, patterns)
        return of_slot.take(self.pattern[rays], axis=1)

    def coefficients(self, rays: slice = slice(None)) -> Array:
        """Coefficients (2, slots, n) of all rays or a range of them, mm per unit of the parameter."""
        return _coefficients(self.kinds, self.xy_mm[:, rays], self.focal_length_mm[rays])


@dataclass(frozen=True)
class SelfCalibration:
    """A set of additional parameters of one camera.

    Attributes
    ----------
    name : of the set
    names : (m,) parameters of the set, ``dc k1 .. th_F``
    sigma : (m,) a-priori sigma of each
    slots : kinds of parameter that act on one ray, in order
    columns : (patterns, slots) int32 parameter behind each slot, for each pattern (CCD line or chip); -1 none
    estimated : (m,) which are unknowns; the others are zero
    chips : per CCD line the first sample of each of its patterns
    weighted : whether the a-priori sigmas carry weight
    stated : parameters whose a-priori sigmas are somebody's knowledge of the camera, not the usual ones
    """

    name: str
    names: tuple[str, ...]
    sigma: Array
    slots: tuple[str, ...]
    columns: NDArray[np.int32]
    estimated: NDArray[np.bool_]
    chips: tuple[tuple[int, ...], ...] = field(repr=False)
    weighted: bool = True
    stated: frozenset[str] = frozenset()

    @property
    def unknown_names(self) -> tuple[str, ...]:
        """Names of the estimated parameters, in the order of the unknowns."""
        return tuple(name for name, on in zip(self.names, self.estimated, strict=True) if on)

    @property
    def n_unknowns(self) -> int:
        return int(self.estimated.sum())

    @property
    def apriori_sigma(self) -> Array:
        """(n_unknowns,) of the estimated parameters."""
        return self.sigma[self.estimated]

    @property
    def assumed(self) -> NDArray[np.bool_]:
        """(n_unknowns,) of the estimated parameters, whether nobody stated the sigma, and it is wide so that the data
        decide. Such a value holds what nothing else determines, and is no observation that sigma0 could be judged
        by."""
        return np.array([name not in self.stated for name in self.unknown_names], dtype=bool)

    @property
    def as_calibrated(self) -> bool:
        """Whether it is what a calibration leaves open, which is stated to be more where the data contradict it."""
        return self.name == LEFT

    @property
    def questioned_names(self) -> tuple[str, ...]:
        """Estimated parameters whose sigmas may be stated larger: of what a calibration leaves open all but the camera
        constant, since over one strip an offset in Z explains as much."""
        questioned = self.as_calibrated and self.weighted
        return tuple(n for n in self.unknown_names if questioned and not n.startswith("dc"))

    def without(self, names: Sequence[str]) -> SelfCalibration:
        """The set with some parameters no longer estimated.

        Raises
        ------
        ValueError : a name that the set does not have
        """
        estimated = self.estimated.copy()
        for name in names:
            estimated[self._place(name)] = False
        return replace(self, estimated=estimated)

    def with_sigma(self, sigma: Mapping[str, float]) -> SelfCalibration:
        """The set with other a-priori sigmas, by parameter or by kind (``{"k1": 1e-6, "th": 1e-4}``)."""
        values, stated = self.sigma.copy(), set(self.stated)
        for name, value in sigma.items():
            if not value > 0:
                raise ValueError(f"a-priori sigma of {name} must be positive, got {value}")
            of_kind = [i for i, n in enumerate(self.names) if n.split("_")[0] == name] or [self._place(name)]
            values[of_kind] = value
            stated.update(self.names[i] for i in of_kind)
        return replace(self, sigma=values, stated=frozenset(stated))

    def scaled(self, share: float) -> SelfCalibration:
        """The set with all a-priori sigmas times a factor.

        Raises
        ------
        ValueError : a factor that is not positive
        """
        if not share > 0:
            raise ValueError(f"factor of the a-priori sigmas must be positive, got {share}")
        return replace(self, sigma=share * self.sigma, stated=frozenset(self.names))

    def free(self) -> SelfCalibration:
        """The set with a-priori sigmas so large that they carry no weight."""
        return replace(self, sigma=self.sigma * FREE, weighted=False, stated=frozenset())

    def design(self, ccd: NDArray[np.int64], sample: Array, xy_mm: Array, focal_length_mm: Array) -> CameraDesign:
        """Coefficients for rays (n,) at image coordinates (n, 2) reduced to the principal point."""
        first = np.cumsum([0, *(len(chips) for chips in self.chips)])
        pattern = first[ccd]
        for k, chips in enumerate(self.chips):
            if len(chips) > 1:
                mine = ccd == k
                pattern[mine] += np.searchsorted(chips, sample[mine] + 0.5, side="right") - 1
        unknown = np.where(self.estimated, np.cumsum(self.estimated) - 1, -1)
        columns = np.append(unknown, -1)[self.columns].astype(np.int32)
        return CameraDesign(pattern, columns, self.slots, xy_mm.T, focal_length_mm)

    def _place(self, name: str) -> int:
        if name not in self.names:
            raise ValueError(f"no additional parameter {name!r} in {self.name}: {' '.join(self.names)}")
        return self.names.index(name)


_Effect = Callable[[Array, Array, Array, Array], tuple[Array | float, Array | float]]
#: Displacement (Dx, Dy) per unit of each kind of parameter, from x, y, r2, c.
_EFFECT: dict[str, _Effect] = {
    "dc": lambda x, y, r2, c: (-x / c, -y / c),
    "k1": lambda x, y, r2, c: (x * r2, y * r2),
    "k2": lambda x, y, r2, c: (x * r2**2, y * r2**2),
    "k3": lambda x, y, r2, c: (x * (r2 * r2 * r2), y * (r2 * r2 * r2)),
    "p1": lambda x, y, r2, c: (r2 + 2 * x * x, 2 * x * y),
    "p2": lambda x, y, r2, c: (2 * x * y, r2 + 2 * y * y),
    "xp": lambda x, y, r2, c: (1.0, 0.0),
    "yp": lambda x, y, r2, c: (0.0, 1.0),
    "dx": lambda x, y, r2, c: (1.0, 0.0),
    "dy": lambda x, y, r2, c: (0.0, 1.0),
    "th": lambda x, y, r2, c: (y, 0.0),
    "sy": lambda x, y, r2, c: (0.0, -y),
    "b": lambda x, y, r2, c: (y * r2, 0.0),
    "s": lambda x, y, r2, c: (0.0, y),
    "turn_x": lambda x, y, r2, c: (-x * y / c, -c - y * y / c),
    "turn_y": lambda x, y, r2, c: (c + x * x / c, x * y / c),
    "turn_z": lambda x, y, r2, c: (y, -x),
}


def _coefficients(kinds: tuple[str, ...], xy_mm: Array, focal_length_mm: Array) -> Array:
    """Displacement (2, kinds, n) in mm per unit of each kind, at image coordinates (2, n)."""
    x, y = xy_mm
    coefficients = np.empty((2, len(kinds), len(x)))
    r2 = x * x + y * y
    for s, kind in enumerate(kinds):
        coefficients[0, s], coefficients[1, s] = _EFFECT[kind](x, y, r2, focal_length_mm)
    return coefficients


def tls(camera: LineCamera, parameters: int = 18) -> SelfCalibration:
    """The 18 parameters of three-line scanners [K 4.43] and the subsets of the 2006 paper.

    16: without the principal point of the line nearest nadir, which goes with the orientation. 12: also without camera
    constant, ``k3``, and scale and inclination of that line.

    Raises
    ------
    ValueError : a count other than 18, 16, 12
    """
    lines = [line.id for line in camera.lines]
    names = list(_TLS_COMMON) + [f"{kind}_{line}" for kind in _TLS_LINE for line in sorted(lines)]
    columns = [[*range(6), *(names.index(f"{kind}_{line}") for kind in _TLS_LINE)] for line in lines]
    full = _set(f"tls{parameters}", names, _TLS_COMMON + _TLS_LINE, columns, [(0,)] * len(lines))
    if parameters == 18:
        return full
    nadir = camera.nadir_line.id
    if parameters == 16:
        return full.without([f"xp_{nadir}", f"yp_{nadir}"])
    if parameters == 12:
        return full.without(["dc", "k3", *(f"{kind}_{nadir}" for kind in _TLS_LINE)])
    raise ValueError(f"TLS sets have 18, 16 or 12 parameters, not {parameters}")


def prism(camera: LineCamera) -> SelfCalibration:
    """Shifts of every chip, and bending and scale of every line [K 4.44]; 30 for three lines of four chips."""
    names: list[str] = []
    columns: list[list[int]] = []
    chips = [line.chips or (0,) for line in camera.lines]
    for line, starts in zip(camera.lines, chips, strict=True):
        shifts = [f"{kind}_{line.id}{n + 1}" for n in range(len(starts)) for kind in ("dx", "dy")]
        names += [*shifts, f"b_{line.id}", f"s_{line.id}"]
        shape = [names.index(f"b_{line.id}"), names.index(f"s_{line.id}")]
        columns += [[names.index(shifts[2 * n]), names.index(shifts[2 * n + 1]), *shape] for n in range(len(starts))]
    name = "prism30" if len(names) == 30 else f"prism{len(names)}"
    return replace(_set(name, names, _PRISM, columns, chips).with_sigma(PRISM_SIGMA), stated=frozenset())


def lens(camera: LineCamera) -> SelfCalibration:
    """Nine parameters of every lens [P]."""
    names = [f"{kind}_{lens.id}" for lens in camera.lenses for kind in _LENS]
    columns = [list(range(9 * i, 9 * i + 9)) for i in camera.lens_of_line]
    return _set("lens", names, _LENS, columns, [(0,)] * len(camera.lines))


def boresight(camera: LineCamera) -> SelfCalibration:
    """Small rotations of the camera against the body about its own axes, rad: the same for all CCD lines and strips.

    The true ``R_lc`` is the measured one times that of the angles omega, phi, kappa; to the first order, rays turn by
    ``-(omega, phi, kappa) x f``. Of one strip alone it cannot be told from the shift of the attitude. TLS has it in
    what xp, yp and th of the lines have in common.
    """
    names = [f"boresight_{angle}" for angle in ("omega", "phi", "kappa")]
    return _set("boresight", names, _TURNS, [[0, 1, 2]] * len(camera.lines), [(0,)] * len(camera.lines))


def focal_length(camera: LineCamera) -> SelfCalibration:
    """The camera constant alone, known to `FOCAL_SIGMA`: what a calibration on the ground leaves open in the air.

    Over one strip of one height it cannot be told from an offset in Z: points are right with either, and the height of
    the camera is as uncertain as both together.
    """
    patterns = [[0]] * len(camera.lines)
    return _set("focal", ["dc"], ("dc",), patterns, [(0,)] * len(camera.lines)).with_sigma({"dc": FOCAL_SIGMA})


def left_by_calibration(camera: LineCamera) -> SelfCalibration:
    """What a calibration leaves open: the camera constant to `FOCAL_SIGMA`, distortion of lenses and places of CCD
    lines to `LEFT_OPEN`. The nadir line of a camera with one lens is the one that the others are measured from."""
    if len(camera.lenses) == 1:
        nadir = camera.nadir_line.id
        parameters = tls(camera).without(["k3", *(f"{kind}_{nadir}" for kind in _TLS_LINE)])
    else:
        parameters = lens(camera)
    constants = {name: FOCAL_SIGMA for name in parameters.names if name.split("_")[0] == "dc"}
    return replace(parameters.scaled(LEFT_OPEN).with_sigma(constants), name=LEFT)


#: Self-calibration by the name the command line uses.
SELF_CALIBRATIONS: dict[str, Callable[[LineCamera], SelfCalibration]] = {
    "tls18": tls,
    "tls16": lambda camera: tls(camera, 16),
    "tls12": lambda camera: tls(camera, 12),
    "prism30": prism,
    "lens": lens,
    "boresight": boresight,
    "focal": focal_length,
    LEFT: left_by_calibration,
}


def calibrated(camera: LineCamera, parameters: SelfCalibration, values: Mapping[str, float]) -> LineCamera:
    """The camera with additional parameters taken into the centres of its pixels: where a ray without them arrives.

    Distortions of lenses are dropped, since the tables have them.

    Parameters
    ----------
    values : by name of the parameter; what is not named is zero

    Raises
    ------
    ValueError : a name that the set does not have
    """
    full = np.zeros(len(parameters.names))
    for name, value in values.items():
        full[parameters._place(name)] = value
    every = replace(parameters, estimated=np.ones(len(parameters.names), dtype=bool))
    lines = []
    for k, line in enumerate(camera.lines):
        sample = np.arange(line.pixels, dtype=float)
        measured = line.xy_mm - camera.principal_point_mm[k]
        ccd = np.full(line.pixels, k, dtype=np.int64)
        c = np.full(line.pixels, camera.focal_length_mm[k])
        # the design takes them at the pixel centres, so one step is exact: centre - D(centre) = projection
        xy = measured - every.design(ccd, sample, measured, c).evaluate(full).T
        lines.append(replace(line, xy_mm=xy + camera.principal_point_mm[k]))
    return replace(camera, lenses=tuple(replace(lens, distortion=()) for lens in camera.lenses), lines=tuple(lines))


def unit_of(name: str) -> str:
    """Unit of an additional parameter, by its name."""
    return _UNITS.get(name.split("_")[0], "")


def _set(
    name: str,
    names: Sequence[str],
    slots: tuple[str, ...],
    columns: Sequence[Sequence[int]],
    chips: Sequence[tuple[int, ...]],
) -> SelfCalibration:
    sigma = np.array([SIGMA[n.split("_")[0]] for n in names])
    table = np.array(columns, dtype=np.int32)
    return SelfCalibration(name, tuple(names), sigma, slots, table, np.ones(len(names), dtype=bool), tuple(chips))
