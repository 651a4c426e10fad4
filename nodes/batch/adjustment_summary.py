"""A batch adjustment in a screenful, from the content of its ``result.json``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from ...solver.adjustment.variance_components import CONSTANTS, LARGEST

Content = Mapping[str, Any]

#: Rejected image points that are listed; the others are in ``result.json``.
MOST_REJECTED = 10

#: Kinds of images of a block of scenes, for people.
_KINDS = {"rigorous": "rigorous", "rpc": "RPC", "affine": "affine model", "dlt": "DLT"}
#: What the differences to given coordinates hold beside the errors of the points.
_WITH_SURVEY = {
    "check": "from sigma and the survey's own",
    "check_single": "from sigma and the survey's own",
    "control": "from the survey's sigma, as it took part",
    "direct_georeferencing": "from sigma and the survey's own",
}


def summary_lines(content: Content, *, verbose: bool = False) -> Iterator[str]:
    """The lines, without ends of line."""
    yield from _head(content)
    yield from _accuracy(content)
    yield from _strips(content)
    yield from _platform(content)
    yield from _parameters(content)
    yield from _components(content)
    yield from _rejected(content, verbose)
    if verbose:
        yield from _details(content)
    for note in content["notes"]:
        yield f"note: {note}"


def _head(c: Content) -> Iterator[str]:
    model = c["model"].upper() + (f", then {c['then'].upper()}" if c["then"] else "")
    calibration = "no self-calibration" if c["selfcal"] == "none" else f"self-calibration {c['selfcal']}"
    kinds = c.get("images", {}).values()
    if kinds and "rigorous" not in kinds:  # neither a trajectory nor a camera to model
        model, calibration = ", ".join(sorted({_KINDS[kind] for kind in kinds})), "corrections in the images"
    yield f"{c['project']}: {model}, {calibration}"
    yield (
        f"{c['n_image_points']} image points, {c['n_points']} object points, {len(c['strips'])} correction sets; "
        f"{c['n_observations']} observations, {c['n_unknowns']} unknowns, redundancy {c['redundancy']}"
    )
    test = c["chi_square_test"]
    if test["passed"] is None:
        tested = "taken, not found: nothing is redundant, and nothing tested"
    else:
        verdict = "passed" if test["passed"] else "FAILED"
        tested = f"chi-square 95 %: {_number(test['low'])} to {_number(test['high'])}, {verdict}"
    yield (
        f"sigma0 {c['sigma0']:.4f} = {c['sigma0_px']:.4f} px ({tested}), "
        f"{c['iterations']} iterations, {'converged' if c['converged'] else 'NOT CONVERGED'}, {c['seconds']:.2f} s"
    )


def _accuracy(c: Content) -> Iterator[str]:
    yield f"{'accuracy, m':24s}{'n':>5s}{'RMSE X':>10s}{'Y':>9s}{'Z':>9s}{'mean X':>10s}{'Y':>9s}{'Z':>9s}" + (
        f"{'sigma X':>10s}{'Y':>9s}{'Z':>9s}"
    )
    for key, name in (
        ("check", "check points"),
        ("check_single", "check points of one ray"),
        ("control", "control points"),
        ("direct_georeferencing", "direct georeferencing"),
    ):
        a = c[key]
        if a["n"]:
            yield f"  {name:22s}{a['n']:5d} {_three(a['rmse_m'])} {_three(a['mean_m'])} {_three(a['sigma_m'])}"
            if _differ(a.get("expected_m"), a["sigma_m"]):
                yield f"  {'  RMSE to be expected':27s} {_three(a['expected_m'])}  {_WITH_SURVEY[key]}"
            if "rmse_px" in a:
                found, wanted = ("{:.3f}, {:.3f}".format(*a[name]) for name in ("rmse_px", "expected_px"))
                yield f"  {'':27s} at the given heights; line, sample: RMSE {found} px, {wanted} px to be expected"
    if c["tie"]["n"]:
        yield f"  {'tie points':22s}{c['tie']['n']:5d} {'':27s} {'':27s} {_three(c['tie']['sigma_m'])}"
    if "dem" in c:
        d = c["dem"]
        yield (
            f"  heights of the raster {d['n']:5d} points with sigma {d['sigma_m']:g} m; "
            f"differences {_number(d['rmse_m'])} m RMS"
            + (f" without {d['half_weight_or_less']} that count half or less" if d["half_weight_or_less"] else "")
        )
        yield (
            f"  {'':22s}{'':5s} raster minus all else {d['shift_m']:+.3f} +- {d['shift_sigma_m']:.3f} m "
            f"(stated {d['shift_sigma_apriori_m']:g} m, w {d['shift_w']:.1f})"
            + ("" if d["holds_height"] else ": NO height datum of the raster")
        )


def _strips(content: Content) -> Iterator[str]:
    for id, strip in content["strips"].items():
        if "offset_m" in strip:
            yield f"{'strip ' + id:22s}{'X, omega':>22s}{'Y, phi':>22s}{'Z, kappa':>22s}"
            for key, name, unit, digits in (
                ("offset_m", "offset", "m", 4),
                ("shift_deg", "shift", "deg", 5),
                ("drift_deg", "drift over the strip", "deg", 5),
            ):
                pairs = zip(strip[key], strip[f"{key}_sigma"], strict=True)
                values = [f"{_digits(v, digits)} +- {_digits(s, digits)}" for v, s in pairs]
                yield f"  {name:20s}" + "".join(f"{v:>22s}" for v in values) + f" {unit}"
        else:
            kind = next((k for k in ("segments", "fixes") if k in strip), None)
            if kind:
                yield f"strip {id}: {len(strip[kind])} {kind}"
        if "coefficients" in strip:
            in_pixels = strip["model"] == "rpc"
            unit = "; px, along lines and samples from the middle of the image to its edge" if in_pixels else ""
            yield f"image {id}, {_KINDS[strip['model']]}{unit}"
            for name, c in strip["coefficients"].items():
                value = f"{c['value']:16.4f}" if in_pixels else f"{c['value']:16.8g}"
                yield f"  {name:24s}{value} +- {_number(c['sigma'], '.4f' if in_pixels else '.3g')}"


def _platform(c: Content) -> Iterator[str]:
    for name, p in c.get("platform", {}).items():
        yield f"{name}: {p['value']:.6f} +- {p['sigma']:.6f} {p['unit']}"


def _parameters(c: Content) -> Iterator[str]:
    parameters = c["additional_parameters"]
    if not parameters:
        return
    kept = {n: p for n, p in parameters.items() if p["status"] == "estimated"}
    yield f"additional parameters: {len(kept)} of {len(parameters)} estimated"
    width = max(6, *(len(name) + 1 for name in parameters))
    for name, p in kept.items():
        reason = f"  {p['reason']}" if p["reason"] else ""
        yield f"  {name:{width}s}{p['value']:13.4e} +- {p['sigma']:.1e} {p['unit']:6s} t {p['t']:8.1f}{reason}"
    for name, p in parameters.items():
        if p["status"] != "estimated":
            yield f"  {name:{width}s}eliminated, {p['reason']}"


def _components(c: Content) -> Iterator[str]:
    for group, v in c["variance_components"].items():
        said = "a-priori kept, " + ("nothing contradicts it" if group in CONSTANTS else "too little redundancy")
        if v["estimated"] and v["sigma_factor"] > 0.999 * LARGEST:
            said = f"a-priori times {LARGEST:g} or more: are units and datum of these observations right?"
        elif v["estimated"]:
            said = f"a-priori times {v['sigma_factor']:.3f} +- {_number(v['sigma_factor_sigma'])}"
        yield f"sigma of {group}: {said} ({v['observations']} observations, redundancy {v['redundancy']:.1f})"


def _rejected(c: Content, verbose: bool) -> Iterator[str]:
    rejected, control = c["rejected"], c["rejected_control"]
    if not rejected and not control:
        return
    if c["doubtful_points"]:
        yield f"doubtful: {len(c['doubtful_points'])} object points that lost too many rays, see the note"
    yield f"rejected: {len(rejected)} image points, {len(control)} control coordinates"
    for r in control:
        yield f"  control point {r['point']}, {r['coordinate']}: w {r['w']:.1f}"
    shown = rejected if verbose else rejected[:MOST_REJECTED]
    for r in shown:
        w = f"w {r['w']:.1f}" if r["w"] else "no w"
        ccd = f", {r['ccd']}" if r["ccd"] else ""
        yield f"  point {r['point']}, strip {r['strip']}{ccd}: {w} ({r['reason']})"
    if len(shown) < len(rejected):
        yield f"  and {len(rejected) - len(shown)} more"


def _details(c: Content) -> Iterator[str]:
    for name, r in c["reliability"].items():
        if r["redundancy_mean"] is not None:
            median, largest = _number(r["detectable_px_median"]), _number(r["detectable_px_max"])
            yield (
                f"reliability, {name}: redundancy numbers {r['redundancy_mean']:.2f} on average, "
                f"{r['redundancy_min']:.2f} least; detectable error {median} px median, {largest} px largest"
            )
    for pair in c["correlations"]:
        yield f"correlation {pair['r']:+.3f}: {pair['between'][0]} with {pair['between'][1]}"
    for u in c["undetermined"]:
        yield f"resting on a-priori weights ({100 * (1 - u['share']):.1f} %): {u['words']}"


def _three(values: Sequence[float | None]) -> str:
    return "".join(f" {'-' if v is None else _metres(v):>8s}" for v in values)


def _metres(value: float) -> str:
    """Four decimals, fewer where the number is large."""
    digits = 4 if abs(value) < 100 else 2 if abs(value) < 1e4 else 0
    return f"{value:.{digits}f}"


def _differ(expected: Sequence[float | None] | None, sigma: Sequence[float | None]) -> bool:
    """Whether the survey tells: by more than 1 %."""
    pairs = zip(expected or (), sigma, strict=False)
    return any(e is not None and s is not None and abs(e - s) > 0.01 * s for e, s in pairs)


def _digits(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _number(value: float | None, spec: str = ".3f") -> str:
    return "-" if value is None else f"{value:{spec}}"
