"""A short flight as a navigation track."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np

from triline.nodes.formats.track import NavigationTrack


def ns(text: str) -> int:
    return round(datetime.fromisoformat(text).replace(tzinfo=UTC).timestamp()) * 10**9


def straight_track(n: int = 50, **more) -> NavigationTrack:
    """Level flight to the north-east, 100 m/s, from 48 deg north."""
    t = np.arange(n) * 0.1
    geodetic = np.column_stack([48.0 + t * 100 / 111_000 * 0.7, 11.0 + t * 100 / 74_000 * 0.7, np.full(n, 2000.0)])
    rpy = np.radians(np.column_stack([np.sin(t), np.cos(t), np.full(n, 45.0)]))
    return NavigationTrack("t", ns("2020-06-01T12:00:00") + np.rint(t * 1e9).astype(np.int64), geodetic, rpy, **more)
