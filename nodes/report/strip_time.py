"""A time axis that leaves out what lies between strips."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from .flight import Flight

Array = NDArray[np.floating]
_GAP = 0.025  # between strips, as a share of the time on strips
_PAUSE_S = 2.0
_SAMPLES = 1200  # of a curve; a page shows no more
_LETTERS = 60  # of a name, and figures of a time, that the width of the axes has room for: half a page


def shortened(name: str, letters: int) -> str:
    """A name of at most so many letters: of a longer one the end, which tells strips apart; "" for fewer than four."""
    if len(name) <= letters:
        return name
    return "…" + name[1 - letters :] if letters >= 4 else ""


class StripTime:
    """Maps seconds since the start of the flight to an axis on which strips stand side by side.

    With one strip, or none that is known, the axis is the time itself.
    """

    def __init__(self, flight: Flight) -> None:
        known = [(flight.strip_times(id), id) for id in flight.strips]
        spans = sorted((*(float(flight.seconds(t)) for t in span), id) for span, id in known if span is not None)
        gap = _GAP * sum(end - start for start, end, _ in spans)
        self.strips: list[tuple[float, float, float, str]] = []  # start, end, place of the start, name
        place = 0.0
        for start, end, id in spans if len(spans) > 1 else ():
            self.strips.append((start, end, place, id))
            place += end - start + gap
        self._gap, self._length = gap, max(place, 1e-9)

    def curve(
        self, time_s: Array, values: Array, pause_s: float = _PAUSE_S, named: NDArray[np.str_] | None = None
    ) -> tuple[Array, Array]:
        """Places and values of a thinned-out curve; NaN where its data pause for longer than ``pause_s``, so that no
        line crosses a pause.

        ``named`` are the strips of the data, "" for what is of none: of strips that are imaged at the same time each
        shows its own, and what is of none.
        """
        t, v = np.asarray(time_s, dtype=float), np.asarray(values, dtype=float)
        if self.strips:
            parts = []
            for start, end, _, id in self.strips:
                inside = (t >= start) & (t <= end)
                parts.append(np.flatnonzero(inside if named is None else inside & ((named == id) | (named == ""))))
            shift = np.repeat([place - start for start, _, place, _ in self.strips], [len(part) for part in parts])
            shown = np.concatenate(parts)
        else:
            shift, shown = np.zeros(len(t)), np.arange(len(t))
        step = max(1, len(shown) // _SAMPLES)
        t, v, shift = t[shown][::step], v[shown][::step], shift[::step]
        x = t + shift
        pauses = np.flatnonzero((np.diff(t) > max(pause_s, _PAUSE_S)) | (np.diff(shift) != 0)) + 1
        return np.insert(x, pauses, np.nan), np.insert(v, pauses, np.nan, axis=0)

    def dress(self, axes: Iterable[Axes], lowest: Iterable[Axes]) -> None:
        """Draw borders and names of strips on all axes, and ticks and a label below the lowest ones."""
        for ax in axes:
            for _, _, place, _ in self.strips[1:]:
                ax.axvline(place - self._gap / 2, color="#999999", lw=0.7, ls=(0, (2, 2)))
            if self.strips:
                ax.grid(False, axis="x")
                for start, end, place, id in self.strips:
                    middle, room = place + (end - start) / 2, int(_LETTERS * (end - start + self._gap) / self._length)
                    anchor = {"transform": ax.get_xaxis_transform(), "ha": "center", "va": "top"}
                    name = shortened(id, room)
                    ax.text(middle, 0.985, name, fontsize=7.5, color="#666666", clip_on=True, **anchor)
        for ax in lowest:
            if self.strips:
                ax.set_xticks([place for _, _, place, _ in self.strips], self._begins())
                ax.set_xlabel("strips side by side; start of each [s]")
            else:
                ax.set_xlabel("time [s]")

    def _begins(self) -> list[str]:
        """When each strip starts, s; "" where the one before leaves no room for it."""
        told: list[str] = []
        free = -np.inf  # from this place on
        for start, _, place, _ in self.strips:
            text = f"{start:.0f}"
            half = (len(text) + 1) / 2 / _LETTERS * self._length
            told.append(text if place - half >= free else "")
            free = place + half if told[-1] else free
        return told
