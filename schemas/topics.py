"""The one table of topics: bus, recorder, replay, monitor and tests read it.

A topic's place in the table is its rank: of two messages with the same platform stamp the one with the lower rank comes
first, live and from a recording. Sensors stand before what is computed from them.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from typing import Any

from . import messages as m


class Queue(Enum):
    """What happens when a subscriber cannot keep up."""

    LOSSLESS = "lossless"  # the publisher is slowed down
    NEWEST = "newest"  # the oldest waiting message is thrown away, and counted


class Family(Enum):
    """Who makes a topic."""

    CONFIGURATION = "configuration"
    SENSOR = "sensor"
    OBSERVATION = "observation"
    RESULT = "result"
    STATUS = "status"
    DECISION = "decision"  # what a live node decided by the load of its machine; recorded, and followed by `process`
    TRUTH = "truth"  # of a simulation; no estimating node may read it


@dataclass(frozen=True)
class Topic:
    """A row of the table.

    Attributes
    ----------
    name : topic; a last part ``*`` stands for any one name (a CCD line, a node)
    type : message class
    family : who makes it
    rate_hz : typical rate, 0 = on events
    queue : policy of the bounded queue in front of a subscriber
    allowed_lateness_ms : platform time within which a message may arrive after its turn without changing a result;
        0 = its publisher stamps it ahead of time, or has said something before it that makes others wait: as long as
        nobody speaks on it, it holds nothing up
    recorded : whether the recorder keeps it
    latched : whether all that was sent so far is handed to whoever joins later
    grace_s : waiting time for which whoever needs its order waits for it when it falls silent, s; 0 = by its rate alone
    order_only : whether it only tells how far its publisher is: sequencers hear it, no node is given it, and as nothing
        follows from it, it cannot be late
    in_bursts : whether many messages come together and then none for a while; only what its publisher says on other
        topics tells whether something is missing
    """

    name: str
    type: Any
    family: Family
    rate_hz: float
    queue: Queue = Queue.LOSSLESS
    allowed_lateness_ms: float = 50.0
    recorded: bool = True
    latched: bool = False
    grace_s: float = 0.0
    in_bursts: bool = False
    order_only: bool = False

    @property
    def type_name(self) -> str:
        return self.type.DESCRIPTOR.full_name

    def matches(self, topic: str) -> bool:
        if self.name.endswith("/*"):
            return (
                topic.startswith(self.name[:-1])
                and "/" not in topic[len(self.name) - 1 :]
                and len(topic) >= len(self.name)
            )
        return topic == self.name


_C, _S, _O, _R = Family.CONFIGURATION, Family.SENSOR, Family.OBSERVATION, Family.RESULT

TOPICS: tuple[Topic, ...] = (
    Topic("configuration/project", m.Project, _C, 0, latched=True),
    Topic("configuration/camera", m.Camera, _C, 0, latched=True),
    Topic("configuration/strip", m.Strip, _C, 0, latched=True),
    Topic("sensor/imu", m.Imu, _S, 200, allowed_lateness_ms=20),
    Topic("sensor/attitude", m.Attitude, _S, 200, allowed_lateness_ms=20),
    Topic("sensor/gnss", m.LocationFix, _S, 5, allowed_lateness_ms=20),
    Topic("sensor/lines/*", m.RawImage, _S, 25, queue=Queue.NEWEST, grace_s=0.5),
    Topic("trajectory/filtered", m.PoseInFrame, _R, 200, allowed_lateness_ms=100),
    Topic("trajectory/smoothed", m.PoseInFrame, _R, 200, allowed_lateness_ms=100, in_bursts=True),
    # known before the flight, or stamped half a second ahead
    Topic("observation/control", m.GroundPoint, _O, 0, allowed_lateness_ms=0, latched=True),
    Topic("observation/verdict", m.Verdict, _O, 0, allowed_lateness_ms=0),
    Topic("observation/tie", m.TiePoint, _O, 50),
    Topic("observation/target", m.TargetLook, _O, 0),
    # whoever makes ties late speaks here before the first of them
    Topic(
        "observation/progress", m.Progress, _O, 20, allowed_lateness_ms=0, recorded=False, grace_s=3.0, order_only=True
    ),
    Topic("orientation/live", m.PoseInFrame, _R, 20, allowed_lateness_ms=1000, grace_s=2.0),
    # what becomes final comes beside orientation/live, and at the end of a strip after it: what its publisher says next
    # tells whether something is missing
    Topic("orientation/final", m.PoseInFrame, _R, 20, allowed_lateness_ms=1000, grace_s=2.0, in_bursts=True),
    Topic("orientation/whole", m.PoseInFrame, _R, 0, allowed_lateness_ms=1000),
    Topic("point/object", m.ObjectPoint, _R, 50, allowed_lateness_ms=1000, grace_s=2.0, in_bursts=True),
    # comes beside orientation/live: what its publisher says there tells whether one is missing, however rare they are;
    # the first one may wait for the matcher being heard first, and no longer than for that
    Topic("adjustment/report", m.AdjustmentReport, _R, 5, allowed_lateness_ms=2000, grace_s=2.0, in_bursts=True),
    Topic("orthoimage/live", m.GroundTile, _R, 2, queue=Queue.NEWEST, allowed_lateness_ms=200),
    Topic("orthoimage/final", m.GroundTile, _R, 2, queue=Queue.NEWEST, allowed_lateness_ms=200),
    Topic("adjustment/pace", m.Pace, Family.DECISION, 0),
    Topic("matching/pace", m.Pace, Family.DECISION, 0),
    Topic("truth/trajectory", m.PoseInFrame, Family.TRUTH, 20),
    Topic("truth/point", m.GroundPoint, Family.TRUTH, 0, latched=True),
    # by what the world of a simulation differs from what is said of it; absent where it does not
    Topic("truth/world", m.Log, Family.TRUTH, 0, latched=True),
    Topic("event/log", m.Log, Family.STATUS, 0),
    Topic("status/*", m.NodeStatus, Family.STATUS, 2, queue=Queue.NEWEST),
)

#: What a flight consists of, and where the platform was: nodes that look at image lines take all of these.
CONFIGURATION = tuple(row.name for row in TOPICS if row.family is Family.CONFIGURATION)
POSES = ("trajectory/filtered", "trajectory/smoothed")
#: What comes at the end of a flight only once the adjuster has seen that nothing more comes.
FINAL = ("orientation/final", "orientation/whole", "point/object")


@lru_cache(maxsize=1024)
def find(topic: str) -> Topic:
    """The row of a topic; raises KeyError for one that is not in the table."""
    for row in TOPICS:
        if row.matches(topic):
            return row
    raise KeyError(topic)


@lru_cache(maxsize=1024)
def begins_flight(topic: str) -> bool:
    """Whether a message on a topic tells that a flight has begun: it was measured, or computed from measurements."""
    row = find(topic)
    return row.family in (Family.SENSOR, Family.OBSERVATION, Family.RESULT) and not row.latched


def may_be_dropped(topic: str) -> bool:
    """Whether a message may be lost on the way, so that it slows nobody down: a newer one follows."""
    return topic.startswith("status/")


@lru_cache(maxsize=1024)
def rank(topic: str) -> int:
    """Place in the table: decides between messages with equal stamps."""
    return TOPICS.index(find(topic))


def key_expression(platform: str, topic: str) -> str:
    """Zenoh key of a topic; ``*`` stays a wildcard."""
    return f"triline/{platform}/{topic}"
