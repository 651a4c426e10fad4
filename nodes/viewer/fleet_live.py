"""A fleet on a canvas: aircraft in the air as they are heard, or their recordings."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterable
from typing import TYPE_CHECKING

from ...schemas import codec, topics
from ...schemas.envelope import RawMessage
from ..node import Message
from .canvas import Canvas
from .fleet_scene import TOPICS, FleetScene

if TYPE_CHECKING:
    from ..bus.session import Bus
    from ..recording.reader import RecordingReader

#: Between two drawings, s; messages that wait for one at most, the oldest are left out.
PERIOD_S, WAITING = 0.5, 50_000


def show_live(bus: Bus, canvas: Canvas, stop: threading.Event) -> int:
    """Draw all aircraft that are heard until told to stop; returns how many messages were used."""
    scene, waiting = FleetScene(canvas), deque[tuple[str, RawMessage]](maxlen=WAITING)
    links: deque[tuple[str, str, bool]] = deque(maxlen=WAITING)
    begun_ns = time.time_ns()
    for name in TOPICS:
        bus.hear(name, lambda platform, raw: waiting.append((platform, raw)))
    bus.watch_fleet(lambda platform, node, alive: links.append((platform, node, alive)))
    while True:
        last = stop.wait(PERIOD_S)
        while links:
            scene.link(*links.popleft())
        for _ in range(len(waiting)):
            platform, raw = waiting.popleft()
            _take(scene, platform, raw, max(raw.receive_ns - begun_ns, 0) / 1e9)
        scene.draw((time.time_ns() - begun_ns) / 1e9)
        if last:
            canvas.close()
            return scene.used


def show_recordings(readers: Iterable[RecordingReader], canvas: Canvas) -> int:
    """Draw recordings of several aircraft in the order of reception; returns how many messages were used."""
    scene, readers = FleetScene(canvas), list(readers)
    names = {reader.path: {c.platform for c in reader.channels.values()} for reader in readers}
    rows = sorted(
        (receive_ns, k, number)
        for k, reader in enumerate(readers)
        for numbers in (reader.select(TOPICS),)
        for receive_ns, number in zip(reader.index.receive_ns[numbers].tolist(), numbers.tolist(), strict=True)
    )
    next_ns = 0
    for receive_ns, k, number in rows:
        reader = readers[k]
        platform = next(iter(names[reader.path]), "") or reader.path.stem
        _take(scene, platform, reader.raw(number), (receive_ns - rows[0][0]) / 1e9)
        if receive_ns >= next_ns:
            scene.draw((receive_ns - rows[0][0]) / 1e9)
            next_ns = receive_ns + int(PERIOD_S * 1e9)
    if rows:
        scene.draw((rows[-1][0] - rows[0][0]) / 1e9)
    canvas.close()
    return scene.used


def _take(scene: FleetScene, platform: str, raw: RawMessage, time_s: float) -> None:
    try:
        topics.find(raw.topic)
        body = codec.decode(raw.topic, raw.data)
    except (KeyError, ValueError):
        return
    scene.take(platform, Message(raw.topic, raw.envelope.stamp_ns, body, raw.envelope.source), time_s)
