"""The viewer: shows what the other nodes say, and never slows them."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterable

from .. import convert
from ..node import Message, Node
from . import scene
from .canvas import Canvas
from .rerun_process import ViewerProcess

_PERIOD_S = 0.5  # between two drawings
_POSE_STEP_NS = 45_000_000  # poses that come faster are not looked at
_MOST_LINES = 100  # blocks of image lines that wait
_FINISH_S = 20.0


class Viewer(Node):
    """Hands messages to a scene that is drawn by a thread of its own.

    The queue between the two is bounded: when drawing cannot keep up, messages are dropped and counted
    (counter ``view dropped``), and `step` returns at once in any case.

    Parameters
    ----------
    mode : ``native``, ``web`` (bound to the loopback interface), ``rrd:PATH`` or ``none``
    queue_size : messages that may wait
    truth : whether to show the truth of a simulation, too
    canvas : what to draw on instead of what ``mode`` names

    Raises
    ------
    UserError : the viewer cannot be started
    """

    name = "viewer"
    inputs = scene.TOPICS + scene.TRUTH_TOPICS
    outputs = ()
    onlooker = True

    def __init__(
        self, mode: str = "native", queue_size: int = 20_000, truth: bool = True, canvas: Canvas | None = None
    ) -> None:
        super().__init__()
        if canvas is None:
            from .rerun_canvas import open_canvas  # takes a second and is not needed for other canvases

            canvas = open_canvas(mode)
        self.mode = mode
        self.canvas = canvas
        self._process: ViewerProcess | None = getattr(canvas, "process", None)
        self._scene = scene.Scene(canvas)
        self._hidden = frozenset() if truth else frozenset(scene.TRUTH_TOPICS)
        self._queue: deque[Message] = deque()
        self._queue_size = queue_size
        self._lines_taken_in = self._lines_worked_off = 0  # each is counted by one thread
        self._last_pose_ns: dict[str, int] = {}
        self._last_stamp_ns = 0  # of a filtered pose
        self._wake = threading.Event()
        self._stop = threading.Event()
        self._failed = ""
        self._thread = threading.Thread(target=self._run, name="viewer", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str | None:
        """Where a browser finds the web viewer; None in other modes."""
        return self._process.web_url if self._process is not None and self._process.web_port else None

    def looks_at(self, topic: str, stamp_ns: int) -> bool:
        if topic != "trajectory/filtered":  # smoothed poses come in batches of one stamp
            return True
        if 0 < stamp_ns - self._last_stamp_ns < _POSE_STEP_NS:
            return False
        self._last_stamp_ns = stamp_ns
        return True

    def step(self, message: Message) -> Iterable[Message]:
        if message.topic in self._hidden:
            return ()
        if message.topic.startswith("trajectory/"):
            time_ns = convert.time_ns(message.body.timestamp)  # poses may come in batches of one stamp
            if 0 <= time_ns - self._last_pose_ns.get(message.topic, 0) < _POSE_STEP_NS:
                return ()
            self._last_pose_ns[message.topic] = time_ns
        if message.topic.startswith(scene.LINES):
            if self._lines_taken_in - self._lines_worked_off >= _MOST_LINES:  # blocks of lines are large
                self.counters["view dropped"] += 1
                return ()
            self._lines_taken_in += 1
        if len(self._queue) >= self._queue_size:
            self.counters["view dropped"] += 1
        else:
            self._queue.append(message)
        return ()

    def finish(self) -> Iterable[Message]:
        """Draw what still waits (20 s at most) and let go of the viewer: a window stays open, a web server ends."""
        self._stop.set()
        self._wake.set()
        self._thread.join(_FINISH_S)
        if self._process is not None and self._process.web_port:
            self._process.close()
        return ()

    def state(self) -> str:
        if self._process is not None and not self._process.running:
            return "the viewer was closed"
        return self._failed or "running"

    def _run(self) -> None:
        while True:
            last_turn = self._wake.wait(_PERIOD_S) or self._stop.is_set()
            try:
                self._draw_waiting()
                if last_turn:
                    self._scene.close()
                self._failed = ""
            except Exception as error:  # a viewer that breaks must not take anything with it, and tries again
                self._failed = f"not drawing: {type(error).__name__}: {error}"
                self.problem("view failed", f"{type(error).__name__}: {error}")
            if last_turn:
                return

    def _draw_waiting(self) -> None:
        while self._queue:
            for _ in range(min(len(self._queue), 2000)):
                message = self._queue.popleft()
                if message.topic.startswith(scene.LINES):
                    self._lines_worked_off += 1
                try:
                    self._scene.take(message)
                except Exception as error:  # whatever a message holds, those after it are drawn
                    self.problem("unusable", f"{message.topic}: {type(error).__name__}: {error}")
            self._scene.draw()
