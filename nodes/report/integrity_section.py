"""The section of the page on integrity: light, protection levels, drifting sources."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from .flight import Flight
from .integrity import LIGHTS, protection_figure
from .page_parts import captioned, number, table

_MDEG = 1000.0
_SHOWN_REASONS, _LEAST_S = 10, 0.5
_NOTE = (
    "Protection level: what could be wrong and not be seen; with a risk of 0.001 the orientation is not further off, "
    "even if one gross error that the tests do not find is among the observations. The ground is the light."
)


def integrity_section(flight: Flight, result: dict[str, Any]) -> Iterable[str]:
    """The light, what the protection levels were and whether they held, and what drifted."""
    said = result.get("integrity")
    if said is None:
        return
    shares = ", ".join(f"{light} {100 * said['share'][light]:.0f} %" for light in LIGHTS)
    yield f"<p>The operator's light over {said['seconds']:.0f} s on strips: <b>{shares}</b>.</p>"
    lasting = [r for r in said["reasons"] if r["seconds"] >= _LEAST_S]
    rows = [(r["light"], r["reason"] or "–", number(r["seconds"], 0), r["times"]) for r in lasting]
    shown = rows[:_SHOWN_REASONS]
    yield table(("light", "reason (numbers: when it first came up)", "time [s]", "times"), shown, left=2, wrapped=(1,))
    if len(rows) > len(shown):
        yield f'<p class="note">The {_SHOWN_REASONS} longest of {len(rows)} reasons.</p>'
    if "protection_m" in said:
        yield "<h3>Protection level of the newest orientation</h3>"
        yield _levels_table(said)
        if "alert_limit_m" in said:
            yield (
                f"<p>On the ground, the worst of four: {said['ground_m']:.2f} m (median); below the alert limit of "
                f"{said['alert_limit_m']:.2f} m in {100 * said['below_limit']:.0f} % of the reports.</p>"
            )
        yield captioned(protection_figure(flight), _NOTE)
    if said["sources"]:
        yield "<h3>Sources of tie points that drifted</h3>"
        yield table(
            ("source", "CCD", "or, as likely", "first alarm [s]", "time [s]", "line [px]", "sample [px]"),
            [
                (
                    s["source"], s["ccd"], ", ".join(s["rivals"]) or "–", number(s["since_s"], 1),
                    number(s["seconds"], 0), f"{s['line_px']:+.2f}", f"{s['sample_px']:+.2f}",
                )
                for s in said["sources"]
            ],
            left=3, wrapped=(2,),
        )  # fmt: skip
        yield '<p class="note">Time: how long it was said to drift. Line and sample: the largest bias.</p>'


def _levels_table(said: dict[str, Any]) -> str:
    heads = ("", "X [m]", "Y [m]", "Z [m]", "ω [mdeg]", "φ [mdeg]", "κ [mdeg]")
    rows = []
    for name, text in (("protection", "protection level, median"), ("sigma", "σ, median")):
        metres, angles = said[f"{name}_m"], [_MDEG * v for v in said[f"{name}_deg"]]
        rows.append((text, *(number(v, 2) for v in metres), *(number(v, 1) for v in angles)))
    if "exceeded" in said:
        rows.append((f"errors beyond it, of {said['compared']}", *said["exceeded"]))
    return table(heads, rows)
