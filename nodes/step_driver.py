"""The only caller of `Node.step`.

Over the bus (`bus.live`) and over a recording (`recording.runner`) a node gets the same messages in the same order, so
the same outputs follow, with the same stamps and numbers.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any

from ..schemas import messages as m
from ..schemas import topics
from .node import Message, Node
from .voices import VERDICT, Voices, is_voiced


class StepDriver:
    """Feeds one node and gives its outputs their envelopes.

    Of configuration, sensors and control the node is given what the source says that spoke first (`Voices`).
    An output cannot be known before its cause: its stamp is raised to the newest stamp the node has been given, so that
    the outputs of a node never go back in time.

    Parameters
    ----------
    node : the node
    clock : measures the wall time of a step, s, for messages that tell it (``compute_s``); None = they tell nothing

    Attributes
    ----------
    first_failure : at what the node's work failed first, and how; empty if it did not
    """

    def __init__(self, node: Node, clock: Callable[[], float] | None = None) -> None:
        self.node = node
        self.time_ns = 0
        self.first_failure = ""
        self.voices = Voices()
        self._clock = clock
        self._sequences: Counter[str] = Counter()
        self._allowed: dict[str, bool] = {}

    @property
    def inputs(self) -> tuple[str, ...]:
        """Topics the node has to be fed from: its own, and an operator's verdicts where topics have one voice."""
        names = self.node.inputs
        return names if VERDICT in names or not any(map(is_voiced, names)) else (*names, VERDICT)

    def step(self, message: Message) -> list[Message]:
        """The outputs that follow from one message; from one that is there for the order alone, nothing does."""
        if topics.find(message.topic).order_only:
            return []
        heard = self.voices.hear(message)
        outputs: list[Message] = []
        for used in heard.pass_on:
            if used.topic == VERDICT and VERDICT not in self.node.inputs:
                continue
            self.time_ns = max(self.time_ns, used.stamp_ns)
            outputs += self._collect(self.node.step, used)
        if not heard.pass_on:
            self.node.counters["not used"] += 1
        if heard.alarms or heard.notes:
            for text in heard.alarms:
                self.node.problem("second voice", text)
            outputs += self._collect(self._told, heard.alarms, "ERROR") + self._collect(self._told, heard.notes, "INFO")
        self.node.alarms["voices"] = self.voices.alarm(self.time_ns)
        return outputs

    def _told(self, lines: Iterable[str], level: str) -> Iterable[Message]:
        """Lines of the event log, of nodes that write into it."""
        for text in lines if "event/log" in self.node.outputs else ():
            body = m.Log(name=self.node.name, message=text, level=m.Log.Level.Value(level))
            body.timestamp.FromNanoseconds(self.time_ns)
            yield Message("event/log", self.time_ns, body)

    def behind(self, lag_s: float, now_s: float, busy_s: float) -> list[Message]:
        """The decisions that follow from being behind; see `Node.behind`."""
        return self._collect(self.node.behind, lag_s, now_s, busy_s)

    def finish(self) -> list[Message]:
        """The outputs that were held back."""
        return self._collect(self.node.finish)

    def _is_allowed(self, topic: str) -> bool:
        """Whether the node may put out a topic."""
        if topic not in self._allowed:
            names = (*self.node.outputs, *self.node.decisions)
            self._allowed[topic] = any(topics.find(name).matches(topic) for name in names)
        return self._allowed[topic]

    def _collect(self, work: Callable[..., Iterable[Message]], *given: Any) -> list[Message]:
        begun = self._clock() if self._clock else 0.0
        outputs: list[Message] = []
        try:
            outputs.extend(work(*given))  # a generator's outputs before a failure count
        except Exception as error:  # whatever a message does to a node, the node lives
            place = _innermost(error)
            text = f"{_cause(*given)}: {type(error).__name__}: {error} ({place})"
            self.node.problem("failed", text)
            self.first_failure = self.first_failure or text
        if not outputs:
            return outputs
        elapsed = self._clock() - begun if self._clock else 0.0
        return [self._stamped(output, elapsed) for output in outputs]

    def _stamped(self, output: Message, elapsed: float) -> Message:
        if not self._is_allowed(output.topic):
            raise ValueError(f"{self.node.name} gave {output.topic}, its outputs are {', '.join(self.node.outputs)}")
        if self._clock and getattr(output.body, "compute_s", None) == 0.0:
            output.body.compute_s = elapsed
        sequence = self._sequences[output.topic]
        self._sequences[output.topic] += 1
        stamp = max(output.stamp_ns, self.time_ns)
        return Message(output.topic, stamp, output.body, self.node.name, sequence)


def failure_words(times: int, why: str) -> str:
    """What is told of a node whose work failed so often; ``why`` says at what."""
    how_often = {1: "once", 2: "twice"}.get(times, f"{times} times")
    return f"failed {how_often}, its results are not complete; {why}"


def _cause(*given: Any) -> str:
    """What a node was working on, by what it was given."""
    if not given:
        return "the end"
    message = given[0]
    return f"{message.topic} {message.sequence}" if isinstance(message, Message) else "being behind"


def _innermost(error: Exception) -> str:
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return "" if trace is None else f"{trace.tb_frame.f_code.co_filename.rsplit('/', 1)[-1]}:{trace.tb_lineno}"
