"""What a node is: messages in, messages out, nothing else.

A node reads only the messages it is given, in the order of their platform stamps, and never a clock: the bus runner and
the recording runner drive the same `Node.step` and get the same answer.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, ClassVar

from .last_problems import shortened


@dataclass(slots=True)  # frozen ones take four times as long to make, and there are hundreds a second
class Message:
    """A message with its envelope; nobody changes one.

    Attributes
    ----------
    topic : e.g. ``sensor/lines/F``
    stamp_ns : platform time (UTC, ns since the Unix epoch) at which it was measured or could be known
    source : id of the publisher
    sequence : number given by the publisher, per topic, from 0; -1 before a runner has given it
    body : the decoded protobuf message
    start : tells one run of the publisher from the next; 0 = not known
    """

    topic: str
    stamp_ns: int
    body: Any
    source: str = ""
    sequence: int = -1
    start: int = 0


#: State of a node that has been told to end.
STOPPING = "stopping"


class Node:
    """Base of all nodes.

    ``inputs`` and ``outputs`` name topics of the topic table. `step` takes one message and returns what follows
    from it; `finish` is called once, when no more messages come, and returns what was still held back. Bad data never
    raises: it is counted with `problem`, or with `refuse` where nothing of a message can be used, dropped, and shown on
    ``status/<node>``.
    """

    name: ClassVar[str]
    inputs: ClassVar[tuple[str, ...]]
    outputs: ClassVar[tuple[str, ...]]
    #: Outputs that are decided live by the load of the machine; in `process` the recorded ones are inputs instead.
    decisions: ClassVar[tuple[str, ...]] = ()
    #: Whether it only shows what others do, so that there may be several of it on a platform.
    onlooker: ClassVar[bool] = False

    def __init__(self) -> None:
        self.counters: Counter[str] = Counter()
        self.last_problem = ""  # the newest
        self.last_problems: dict[str, str] = {}  # the newest of each kind
        self.refusals = 0  # messages of which nothing could be used when they came
        self.refused_later: Counter[str] = Counter()  # of those that had waited in the node; by topic, runners take it
        self.alarms: dict[str, str] = {}  # what an operator has to look at now, by kind; runners set some of them

    def step(self, message: Message) -> Iterable[Message]:
        """What follows from one message."""
        raise TypeError(f"{type(self).__name__} does not define step")

    def looks_at(self, topic: str, stamp_ns: int) -> bool:
        """Whether a node without outputs wants a message at all; live, what it does not want is not even decoded."""
        return True

    def finish(self) -> Iterable[Message]:
        """What was still held back when the last message has come."""
        return ()

    def behind(self, lag_s: float, now_s: float, busy_s: float) -> Iterable[Message]:
        """What follows from working on messages that have waited for ``lag_s``; live only.

        Parameters
        ----------
        lag_s : waiting time of the message that was worked on last, s
        now_s : a steady clock, s
        busy_s : for how long the node has worked on messages so far, s
        """
        return ()

    def state(self) -> str:
        """One phrase for the status line, e.g. ``running`` or ``waiting for configuration/camera``."""
        return "running"

    def light(self) -> tuple[str, str]:
        """The operator's light, "good", "weak" or "failed", and the reason; empty for nodes without one."""
        return "", ""

    @property
    def alarm(self) -> str:
        """All alarms as one line; empty if there are none."""
        return "; ".join(dict.fromkeys(filter(None, self.alarms.values())))

    def problem(self, kind: str, text: str) -> None:
        """Count bad data of a kind and keep one line about its newest case.

        A kind is a short counter name, one of few that the program knows and never made of the data.
        """
        self.counters[kind] += 1
        self.keep_problem(kind, text)

    def keep_problem(self, kind: str, text: str) -> None:
        """Keep one line about the newest case of a kind that is counted elsewhere."""
        self.last_problem = self.last_problems[kind] = shortened(text)

    def refuse(self, kind: str, text: str) -> None:
        """Count a message of which nothing can be used as bad data of a kind."""
        self.refusals += 1
        self.problem(kind, text)
