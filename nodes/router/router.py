"""``triline node router``: by its bundle the router of an aircraft, or one on the ground.

On the ground it is a Zenoh router with the access list of the bundle. On board it stands between two sessions: one
among the nodes of the aircraft, one that calls the ground. From board to ground it hands on what `bus.downlink` names,
in its order, at so many bytes a second; from the ground it takes verdicts and questions. Neither a slow link nor one
that is gone ever makes a node on board wait, and nothing on board can be reached from the ground past it.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Iterator

from ...schemas import codec, topics
from ...schemas.envelope import RawMessage
from ...schemas.topics import Family
from ..bus.authority import AIRCRAFT, ROUTER, UPLINK_TOPICS
from ..bus.downlink import (
    ANSWER_OVERHEAD,
    GAPS,
    PORTION_BYTES,
    QUESTIONS,
    SHARES,
    VERDICT_AHEAD_NS,
    Meter,
    Waiting,
    asked,
    cost,
    for_the_link,
    share_of,
)
from ..bus.program import ProgramOptions
from ..bus.session import LINK, Bus, routing, why_no_listening
from ..bus.status import StatusPublisher
from ..config import build
from ..errors import UserError
from ..node import STOPPING, Node
from ..ordering import TopicCounts

#: The ground is called again after so long where it does not answer, s.
CALL_AGAIN_S = 1.0
#: The router on the ground is asked so often whether the link carries anything, s; when it has not answered for so long
#: the link is gone. TCP alone would try again ever more rarely, and carry on minutes after the link is back.
LINK_S, LINK_GONE_S = 2.0, 12.0
#: Answers of nodes on board take so long at most, s.
ANSWER_S = 10.0


class OnBoardRouter(Node):
    """What an on-board router does between two sessions.

    Parameters
    ----------
    bytes_s : bytes a second that go down at most, all that the link carries counted; 0 = no limit
    """

    name = "router"
    inputs = tuple(share.topic for share in SHARES)
    outputs = ()

    def __init__(self, bytes_s: float = 64_000) -> None:
        super().__init__()
        if bytes_s < 0:
            raise ValueError(f"bytes_s is {bytes_s}, wanted 0 or more")
        self.waiting = Waiting()
        self.meter = Meter(bytes_s)
        self.sent: Counter[str] = Counter()
        self.newest_ns = 0
        self.linked = False
        self._stop = threading.Event()
        self._passed: set[tuple[str, str, int, int]] = set()  # of what goes both ways
        self._passing = threading.Lock()

    def state(self) -> str:
        sent = f"{self.meter.passed / 1e6:.1f} MB down"
        return f"linked, {sent}" if self.linked else f"no link to the ground, {sent}"

    def uplink(self, raw: RawMessage) -> RawMessage:
        """What the ground says, stamped ahead of the platform time here: the desk knows an older one."""
        stamp_ns = max(raw.envelope.stamp_ns, self.newest_ns + VERDICT_AHEAD_NS)
        return raw._replace(envelope=raw.envelope._replace(stamp_ns=stamp_ns))

    def passes(self, raw: RawMessage) -> bool:
        """Whether a message of what goes both ways is new here: each session hears what it says itself, and what was
        handed on up or down would go round for ever."""
        key = (raw.topic, raw.envelope.source, raw.envelope.start, raw.envelope.sequence)
        with self._passing:
            new = key not in self._passed
            self._passed.add(key)
        return new

    def take(self, raw: RawMessage) -> None:
        """A message of a node on board; never waits."""
        if raw.topic in UPLINK_TOPICS and not self.passes(raw):
            return
        if topics.find(raw.topic).family not in (Family.STATUS, Family.OBSERVATION):
            self.newest_ns = max(self.newest_ns, raw.envelope.stamp_ns)
        share = share_of(raw.topic)
        if share is None or (raw.envelope.sequence % share.every and not _is_last_word(raw)):
            return
        if not self.linked and not topics.find(raw.topic).latched:
            return  # the ground asks for it when it is back
        try:
            self.waiting.put(for_the_link(raw), share.turn)
        except ValueError as error:
            self.problem("malformed", f"{raw.topic}: {error}")

    def hears(self, ground: Bus) -> bool:
        """Whether the router on the ground answers."""
        try:
            return any(True for _ in ground.ask(LINK, LINK_GONE_S))
        except ValueError:
            return False

    def send(self, ground: Bus, timeout_s: float) -> None:
        """Send the next message that waits, at its turn."""
        found = self.waiting.take(timeout_s)
        if found is None:
            return
        raw, turn = found
        if not self.linked and not topics.find(raw.topic).latched:
            return
        if self.meter.let_pass(cost(raw), turn, self._stop.is_set):
            ground.publish_raw(raw)
            self.sent[raw.topic] += 1

    def answer(self, board: Bus, name: str, parameters: dict[str, str]) -> Iterator[RawMessage]:
        """Answers of nodes on board, as fast as the link allows; a long one is cut, the ground asks on.

        Raises
        ------
        ValueError : a question for what stays on board, or the refusal of who was asked
        """
        if name == "recorded":
            topic = asked(parameters).topic
            if topic.startswith("sensor/lines/"):
                raise ValueError(f"{topic} stays on board")
        spent = 0
        for raw in board.ask(name, ANSWER_S, **parameters):
            small = for_the_link(raw)
            if spent > PORTION_BYTES:
                return
            n = cost(small, ANSWER_OVERHEAD)
            if not self.meter.let_pass(n, GAPS, self._stop.is_set):
                raise ValueError("the router ends")
            spent += n
            yield small

    def statistics(self) -> dict[str, TopicCounts]:
        """Messages sent, by topic."""
        return {topic: TopicCounts(received=n) for topic, n in self.sent.items()}

    def end(self) -> None:
        """Let go of whoever waits for the link."""
        self._stop.set()


def _is_last_word(raw: RawMessage) -> bool:
    """Whether a node says that it is being stopped: without it the ground would take it for dead."""
    if not raw.topic.startswith("status/"):
        return False
    try:
        return codec.parse(raw.topic, bytes(raw.data)).state == STOPPING
    except ValueError:
        return False


def run(options: ProgramOptions) -> int:
    """Route until told to stop."""
    secure = options.secure
    if secure is None:
        raise UserError("wanted --secure BUNDLE: of a router on the ground, or of an aircraft that calls one")
    if secure.kind == ROUTER:
        return _on_the_ground(options)
    if secure.kind != AIRCRAFT:
        raise UserError(f"--secure {secure.folder}: is of a {secure.kind}, wanted that of a router or an aircraft")
    if secure.ground_link is None:
        raise UserError(
            f"--secure {secure.folder}: this aircraft calls no router; certify it with `triline keys aircraft "
            f"{secure.name} --router HOST`"
        )
    return _on_board(options)


def _on_the_ground(options: ProgramOptions) -> int:
    assert options.secure is not None
    for why in why_no_listening(options.secure.configuration, options.port):
        options.report(f"router {options.secure.name} cannot listen on {why}; it tries again")
    with routing(options.secure.configuration, options.port) as linked:
        options.report(f"router {options.secure.name} on port {options.port or options.secure.port}")
        before = 0
        while not options.stop.wait(1.0):
            now = linked()
            if now != before:
                options.report(f"router {options.secure.name}: {now} linked")
                before = now
    options.report(f"router {options.secure.name} stopped")
    return 0


def _on_board(options: ProgramOptions) -> int:
    router = build(OnBoardRouter, options.tables, "router")
    with options.open_bus() as board:
        ground = _call(options)
        if ground is None:
            return 0
        with ground:
            _between(router, board, ground, options)
    left = f", {router.waiting.left_out} left out (the ground asks for them)" if router.waiting.left_out else ""
    options.report(f"router stopped; {router.meter.passed / 1e6:.1f} MB down{left}")
    return 0


def _call(options: ProgramOptions) -> Bus | None:
    """The session to the ground, as soon as a router answers there; None when told to stop before."""
    assert options.secure is not None
    told = ""
    while not options.stop.is_set():
        try:
            return Bus(options.platform, source="router", file=options.secure.ground_link, keep=False)
        except UserError as error:
            why = f"no link to the ground: {error}"
            if why != told:
                options.report(why)
                told = why
        options.stop.wait(CALL_AGAIN_S)
    return None


def _between(router: OnBoardRouter, board: Bus, ground: Bus, options: ProgramOptions) -> None:
    """Hand on between two sessions until told to stop."""

    def questions(name: str) -> None:
        ground.answer_messages(name, lambda parameters: router.answer(board, name, parameters))

    def sender() -> None:
        while not options.stop.is_set():
            router.send(ground, 0.1)

    def watch() -> None:
        while not options.stop.wait(LINK_S):
            router.linked = router.hears(ground)
            while not router.linked and not ground.open_anew("the link was gone"):
                if options.stop.wait(LINK_S):
                    return

    ground.announce("router")
    for name in QUESTIONS:
        questions(name)

    def up(raw: RawMessage) -> None:
        if router.passes(raw):
            board.publish_raw(router.uplink(raw))

    for topic in UPLINK_TOPICS:
        ground.subscribe(topic, up)
    for name in router.inputs:
        board.subscribe(name, router.take)
    board.announce("router")
    sending = threading.Thread(target=sender, name="downlink")
    sending.start()
    watching = threading.Thread(target=watch, name="link", daemon=True)
    watching.start()
    status = StatusPublisher(board, "router")
    told = None
    while not options.stop.wait(0.1):
        if router.linked != told:
            told = router.linked
            options.report(f"router: {router.state()}")
        router.counters["left out"] = router.waiting.left_out
        router.counters["bytes"] = router.meter.passed
        if status.due():
            queued = len(router.waiting)
            status.publish(router.state(), router.statistics(), router, 0.0, queued, router.newest_ns)
    router.end()
    sending.join()
    time.sleep(0.1)
