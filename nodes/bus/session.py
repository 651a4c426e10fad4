"""The bus: Zenoh sessions that find each other on one machine, or as a configuration file says. The only file that
knows Zenoh.

Every session is a peer. Who comes first listens on the meeting port; all others connect to it, learn of each other
there and link directly. When its owner dies they stay linked, and who comes next takes the port over: all others try it
again and again. Nobody is a hub that all depend on.
"""

from __future__ import annotations

import contextlib
import json
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import zenoh
import zenoh.ext

from ...schemas import codec, topics
from ...schemas.envelope import Envelope, RawMessage, pack, unpack
from ..errors import UserError
from ..node import Message
from .links import BEAT_S, LinkWatch
from .ports import default_port, port_is_held, why_not_free
from .zenoh_words import one_line

if TYPE_CHECKING:  # certificates take a tenth of a second to import
    from .bundle import Bundle

#: Messages of a latched topic that a publisher keeps for whoever joins later.
LATCHED_KEPT = 100_000
#: What else is recorded, and is not too much (pictures), a publisher keeps for those who missed it: for so long, s, at
#: twice the usual rate of its topic, and so many messages at least.
KEPT_S, LEAST_KEPT = 60.0, 20_000
#: Publishers that do not answer are asked again for what they keep, for so long, s.
ASKED_S = 10.0
_RETRY = {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5}

Receive = Callable[[RawMessage], None]
ReceiveOf = Callable[[str, RawMessage], None]
AnswerRaw = Callable[[dict[str, str]], Iterable[RawMessage]]
Malformed = Callable[[str, str], None]
Answer = Callable[[dict[str, str]], Any]
Recipe = Callable[[Any, int], Any]
#: For so long a session stays open beside the one that takes its place, s.
BOTH_S = 1.0
#: What every session answers when it has taken off the wire what the one that asks had said before; and for so long one
#: that is about to end waits for these answers, s. A frozen program gives none.
TAKEN, TAKEN_S = "taken", 5.0
#: A program that ends waits for so long for a session that is still being closed, s.
CLOSED_S = 5.0
#: What a router answers, of any platform, to who wants to know whether his link carries anything.
LINK = "link"
#: Names of topics that others tell are shorter than this.
LONGEST_TOPIC = 200


def configuration(port: int | None = None, file: str | Path | None = None) -> zenoh.Config:
    """The Zenoh configuration: of a file, or peer to peer on loopback."""
    if file is not None:
        if not Path(file).is_file():
            raise UserError(f"{file}: no such Zenoh configuration file")
        try:
            config = zenoh.Config.from_file(file)
        except Exception as error:
            raise UserError(f"{file}: not a Zenoh configuration: {one_line(error)}") from None
        config.insert_json5("timestamping/enabled", "true")  # late joiners are served by time
        if port is not None:  # of a bundle, on another port than it says
            for key in ("listen/endpoints", "connect/endpoints"):
                there = json.loads(config.get_json(key))
                moved = [re.sub(r":(?!0$)\d+$", f":{port}", endpoint) for endpoint in there]
                config.insert_json5(key, json.dumps(moved))
        return config
    endpoint = f"tcp/127.0.0.1:{port or default_port()}"
    config = zenoh.Config()
    for key, value in {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": True,
        "listen/endpoints": [endpoint, "tcp/127.0.0.1:0"],
        "listen/timeout_ms": 0,
        "listen/exit_on_failure": False,
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": _RETRY,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": 4000,  # ms after which a frozen peer counts as gone
        # us for which one who does not read may hold a publisher; then the link is closed, and made anew
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 2_000_000,
        "timestamping/enabled": True,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return config


def why_no_listening(file: Path, port: int | None = None) -> list[str]:
    """Where a router cannot listen now, and why: it tries again, without a word.

    Parameters
    ----------
    file, port : as of `routing`
    """
    told = []
    for endpoint in _router_endpoints(configuration(file=file), port):
        found = re.fullmatch(r"\w+/\[?([^\]]+?)\]?:(\d+)", endpoint)
        if found is None:
            continue
        why = why_not_free(found[1], int(found[2]))
        if why:
            told.append(f"{found[1]}:{found[2]}: {why}")
    return told


def _router_endpoints(config: zenoh.Config, port: int | None) -> list[str]:
    """Where a router listens by its configuration, or on another port."""
    endpoints = json.loads(config.get_json("listen/endpoints"))
    return endpoints if port is None else [re.sub(r":\d+$", f":{port}", endpoint) for endpoint in endpoints]


class Bus:
    """A session on the bus of one platform.

    Parameters
    ----------
    platform : name of the platform, a part of every key
    source : id under which this program publishes
    port : meeting port on loopback; None = TRILINE_PORT or 17447
    file : a Zenoh configuration file instead
    secure : a bundle of certificates and access lists; with a port it meets there instead of where the bundle says
    keep : whether what is said is kept for those who missed it; what is latched always is

    Raises
    ------
    UserError : a name that cannot be a platform's, a configuration that is none, or no router where one is called
    """

    def __init__(
        self,
        platform: str = "demo",
        *,
        source: str = "",
        port: int | None = None,
        file: str | Path | None = None,
        secure: Bundle | None = None,
        keep: bool = True,
    ) -> None:
        if not platform or any(c in platform for c in "/*$?#@ "):
            raise UserError(f"platform {platform!r}, wanted a name without blanks and any of / * $ ? # @")
        zenoh.init_log_from_env_or("off")
        self.platform = platform
        self.source = source
        self.start = time.time_ns()
        self._secure = secure
        self._keep = keep
        if secure is not None:
            file = secure.configuration
            self._port = port
        else:
            self._port = None if file is not None else port or default_port()
        self._file = file
        held = secure is None and self._port is not None and port_is_held(self._port)
        try:
            self._session = zenoh.open(configuration(self._port, file))
        except zenoh.ZError as error:
            where = f"{file}: " if file is not None else ""
            raise UserError(f"{where}cannot open the bus: {self._why_closed() or one_line(error)}") from None
        self._publishers: dict[str, Any] = {}
        self._recipes: list[Recipe] = []  # how all that is declared is declared again
        self._declared: list[Any] = []
        self._sequences: dict[str, int] = {}
        self._held = held  # by others, when this session was opened
        self._lock = threading.RLock()
        self._opening = threading.Lock()
        self._generation = 0  # of the session: what comes from an earlier one is not handed on
        self._latched: deque[RawMessage] = deque(maxlen=LATCHED_KEPT)
        self._links = LinkWatch()
        self._closing: list[threading.Thread] = []  # of sessions that others have replaced
        self._ended = threading.Event()
        #: Why this session was opened anew, the newest last.
        self.opened_anew: list[str] = []
        self._declare(self._hear_of_others)
        self._declare(self._tell_taken)
        threading.Thread(target=self._watch_links, name="links", daemon=True).start()

    def __enter__(self) -> Bus:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def key(self, topic: str) -> str:
        """Key expression of a topic."""
        return topics.key_expression(self.platform, topic)

    # ---- publishing

    def prepare(self, names: Iterable[str]) -> None:
        """Declare topics ahead of their first message, so that nobody has to learn of them while it is on its way."""
        for name in names:
            if not name.endswith("*"):
                self._publisher(name)

    def publish(self, message: Message) -> None:
        """Publish a message; one without source or number gets this session's source and the next number."""
        sequence = message.sequence
        if sequence < 0:
            sequence = self._sequences.get(message.topic, 0)
            self._sequences[message.topic] = sequence + 1
        envelope = Envelope(message.stamp_ns, message.source or self.source, sequence, self.start)
        self.publish_raw(RawMessage(message.topic, envelope, codec.encode(message.body)))

    def publish_raw(self, raw: RawMessage) -> None:
        """Publish an encoded message with the envelope it has."""
        data = raw.data if isinstance(raw.data, bytes) else bytes(raw.data)
        attachment = pack(raw.envelope)
        if topics.find(raw.topic).latched:
            self._latched.append(raw)
        try:
            self._publisher(raw.topic).put(data, attachment=attachment)
        except zenoh.ZError:
            if self._ended.is_set():
                raise
            self._publisher(raw.topic).put(data, attachment=attachment)  # the session was opened anew meanwhile

    def _publisher(self, topic: str) -> Any:
        if self._secure is not None and topic not in self._publishers:
            refused = self._secure.refuses(self.platform, topic)
            if refused:
                raise UserError(refused)
        with self._lock:
            if topic not in self._publishers:
                self._publishers[topic] = self._declare_publisher(topic, self._session)
            return self._publishers[topic]

    def _declare_publisher(self, topic: str, session: Any) -> Any:
        row = topics.find(topic)
        dropped = topics.may_be_dropped(topic)
        options: dict[str, Any] = {
            "encoding": zenoh.Encoding.APPLICATION_PROTOBUF.with_schema(row.type_name),
            "congestion_control": zenoh.CongestionControl.DROP if dropped else zenoh.CongestionControl.BLOCK,
        }
        kept = _kept(row) if self._keep or row.latched else 0
        if not kept:
            return session.declare_publisher(self.key(topic), **options)
        cache = zenoh.ext.CacheConfig(max_samples=kept)
        return zenoh.ext.declare_advanced_publisher(
            session, self.key(topic), cache=cache, publisher_detection=row.latched, **options
        )

    # ---- receiving

    def subscribe(self, name: str, receive: Receive, malformed: Malformed | None = None) -> Callable[[], None]:
        """Call ``receive`` with every message of a topic (a name of the table, wildcard included).

        Returns a function that ends it.

        It is called in the thread that takes messages off the wire: while it waits, the publisher waits. For a latched
        topic it also gets what was sent before. What has no readable envelope goes to ``malformed(topic, why)``.
        """
        return self._subscribe(self.key(name), name, lambda _, raw: receive(raw), malformed)

    def hear(self, name: str, receive: ReceiveOf, malformed: Malformed | None = None) -> Callable[[], None]:
        """`subscribe` to a topic of all platforms: ``receive(platform, message)``."""
        return self._subscribe(topics.key_expression("*", name), name, receive, malformed)

    def _subscribe(self, key: str, name: str, receive: ReceiveOf, malformed: Malformed | None) -> Callable[[], None]:
        listens = True

        def take(sample: Any, generation: int) -> None:
            receive_ns = time.time_ns()
            _, platform, topic = str(sample.key_expr).split("/", 2)
            if sample.kind != zenoh.SampleKind.PUT or generation != self._generation:
                return
            if platform == self.platform and listens:
                self._links.heard(topic, time.monotonic())
            try:
                if sample.attachment is None:
                    raise ValueError("message without an envelope")
                envelope = unpack(sample.attachment.to_bytes())
            except ValueError as error:
                if malformed is not None:
                    malformed(topic, str(error))
                return
            receive(platform, RawMessage(topic, envelope, sample.payload.to_bytes(), receive_ns))

        def declare(session: Any, generation: int) -> Any:
            handler = zenoh.handlers.Callback(lambda sample: take(sample, generation), indirect=False)
            if topics.find(name).latched:
                return zenoh.ext.declare_advanced_subscriber(
                    session,
                    key,
                    handler,
                    history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=LATCHED_KEPT),
                )
            return session.declare_subscriber(key, handler)

        withdraw = self._declare(declare)

        def end() -> None:
            nonlocal listens
            listens = False
            withdraw()
            self._links.unwanted(name)

        return end

    def recall(self, names: Iterable[str], seconds: float = KEPT_S, timeout_s: float = 3.0) -> list[RawMessage]:
        """What others have said lately on topics (names of the table), as far as they live and keep it, in any order.

        Of topics that are latched it is all that was ever said. Whoever subscribes to one gets that, too, but is asked
        for once alone: on a busy machine the answer may come too late. Where a publisher does not answer here in time,
        all are asked again, until `ASKED_S` have passed.
        """
        found: dict[tuple[str, Envelope], RawMessage] = {}
        until_s = time.monotonic() + ASKED_S
        for name in filter(is_kept, names):
            while not self._recall(name, seconds, timeout_s, found) and time.monotonic() < until_s:
                pass
        return list(found.values())

    def _recall(
        self, name: str, seconds: float, timeout_s: float, found: dict[tuple[str, Envelope], RawMessage]
    ) -> bool:
        """Add what was said lately on a topic; whether all who keep it have answered."""
        lately = "" if topics.find(name).latched else f"?_time=[now(-{seconds:.3f}s)..]"
        replies = self._session.get(
            f"{self.key(name)}/@adv/**{lately}",  # where `zenoh.ext` answers from its cache
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            accept_replies=zenoh.ReplyKeyExpr.ANY,
            timeout=timeout_s,
        )
        receive_ns, prefix, complete = time.time_ns(), len(self.key("")), True
        for reply in replies:
            sample = reply.ok
            if sample is None:
                complete = False  # the time is over
            elif sample.attachment is not None:
                with contextlib.suppress(ValueError):  # what has no envelope was told when it came
                    envelope = unpack(sample.attachment.to_bytes())
                    if envelope.start != self.start:
                        topic = str(sample.key_expr)[prefix:]
                        raw = RawMessage(topic, envelope, sample.payload.to_bytes(), receive_ns)
                        found.setdefault((topic, envelope), raw)
        return complete

    # ---- liveliness and queries

    def announce(self, node: str) -> None:
        """Show that a node lives, until this session ends in whatever way."""
        self._declare(lambda session, _: session.liveliness().declare_token(self.key(f"alive/{node}")))

    def watch(self, changed: Callable[[str, bool], None]) -> None:
        """Call ``changed(node, alive)`` for the nodes that live now and whenever one comes or goes."""

        self._watch(self.key("alive/*"), lambda _, node, alive: changed(node, alive))

    def watch_fleet(self, changed: Callable[[str, str, bool], None]) -> None:
        """The same for the nodes of all platforms: ``changed(platform, node, alive)``."""
        self._watch(topics.key_expression("*", "alive/*"), changed)

    def _watch(self, key: str, changed: Callable[[str, str, bool], None]) -> None:
        def take(sample: Any) -> None:
            _, platform, _, node = str(sample.key_expr).split("/", 3)
            changed(platform, node, sample.kind == zenoh.SampleKind.PUT)

        def declare(session: Any, _: int) -> Any:
            handler = zenoh.handlers.Callback(take, indirect=False)
            return session.liveliness().declare_subscriber(key, handler, history=True)

        self._declare(declare)

    def alive(self, timeout_s: float = 1.0) -> set[str]:
        """Names of the nodes that live now."""
        replies = self._session.liveliness().get(self.key("alive/*"), timeout=timeout_s)
        return {str(reply.ok.key_expr).rsplit("/", 1)[1] for reply in replies if reply.ok is not None}

    def answer(self, name: str, answer: Answer) -> None:
        """Answer queries ``query/<name>?key=value;..``: ``answer`` gives a message body, or None for none."""
        key = self.key(f"query/{name}")

        def take(query: Any) -> None:
            with query:
                try:
                    body = answer(dict(_parameters(str(query.parameters))))
                except ValueError as error:
                    query.reply_err(str(error).encode(), encoding="text/plain")
                    return
                if body is not None:
                    encoding = zenoh.Encoding.APPLICATION_PROTOBUF.with_schema(body.DESCRIPTOR.full_name)
                    query.reply(key, codec.encode(body), encoding=encoding)

        self._declare(lambda session, _: session.declare_queryable(key, zenoh.handlers.Callback(take)))

    def query(self, name: str, topic: str, timeout_s: float = 2.0, **parameters: object) -> list[Any]:
        """Bodies (of the type of ``topic``) that answer a query; raises ValueError with the reason of a refusal."""
        selector = self.key(f"query/{name}")
        if parameters:
            selector += "?" + ";".join(f"{key}={value}" for key, value in parameters.items())
        bodies = []
        for reply in self._session.get(selector, timeout=timeout_s):
            if reply.ok is None:
                raise ValueError(reply.err.payload.to_string() if reply.err is not None else "no reason given")
            bodies.append(codec.decode(topic, reply.ok.payload.to_bytes()))
        return bodies

    def answer_messages(self, name: str, answer: AnswerRaw) -> None:
        """Answer queries ``query/<name>?key=value;..`` with messages as they were said; see `ask`.

        ``answer`` is called in a thread of its own kind of query, one query at a time; it may take its time between two
        messages. Where it raises ValueError, that is the answer.
        """
        key = self.key(f"query/{name}")

        def take(query: Any) -> None:
            with query:
                try:
                    for raw in answer(dict(_parameters(str(query.parameters)))):
                        query.reply(self.key(raw.topic), bytes(raw.data), attachment=pack(raw.envelope))
                except ValueError as error:
                    query.reply_err(str(error).encode(), encoding="text/plain")
                except zenoh.ZError:  # who asked is gone
                    return

        self._declare(lambda session, _: session.declare_queryable(key, zenoh.handlers.Callback(take)))

    def ask(self, name: str, timeout_s: float = 2.0, platform: str = "", **parameters: object) -> Iterator[RawMessage]:
        """Messages that answer a query, of this platform or another one, as they come.

        Raises
        ------
        ValueError : the reason of a refusal; or the time was over before the answer was whole
        """
        prefix = topics.key_expression(platform or self.platform, "")
        selector = f"{prefix}query/{name}"
        if parameters:
            selector += "?" + ";".join(f"{key}={value}" for key, value in parameters.items())
        replies = self._session.get(
            selector,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            accept_replies=zenoh.ReplyKeyExpr.ANY,
            timeout=timeout_s,
            priority=zenoh.Priority.REAL_TIME if name == LINK else zenoh.Priority.DATA,
        )
        for reply in replies:
            if reply.ok is None:
                raise ValueError(reply.err.payload.to_string() if reply.err is not None else "no reason given")
            sample = reply.ok
            if sample.attachment is not None:
                envelope, topic = unpack(sample.attachment.to_bytes()), str(sample.key_expr)[len(prefix) :]
                yield RawMessage(topic, envelope, sample.payload.to_bytes(), time.time_ns())

    def peers(self) -> int:
        """How many sessions this one is linked with."""
        info = self._session.info
        return len(info.peers_zid()) + len(info.routers_zid())

    def _why_closed(self) -> str:
        """Why a session that calls routers cannot be opened; "" if nothing is seen."""
        if self._secure is None or self._file is None:
            return ""
        config = configuration(self._port, self._file)
        if json.loads(config.get_json("mode")) != "client":
            return ""
        why = self._secure.why_nobody(json.loads(config.get_json("connect/endpoints")))
        return f"nobody can be met: {why or 'no router answers'}"

    def why_alone(self, patience_s: float = 3.0) -> str:
        """Why this session meets nobody: a program that is none of ours holds the meeting port; "" if none does."""
        until = time.monotonic() + patience_s
        if self._secure is not None and self._secure.is_desk:  # an aircraft's first node is alone for a while
            while not self.peers():
                if time.monotonic() > until:
                    endpoints = json.loads(configuration(self._port, self._file).get_json("connect/endpoints"))
                    why = self._secure.why_nobody(endpoints)
                    return f"nobody can be met: {why or 'no node answers'}"
                time.sleep(0.02)
            return ""
        while self._held and not self.peers():
            if time.monotonic() > until:
                from .bundle import speaks_tls

                if speaks_tls("127.0.0.1", self._port or 0):
                    return f"nobody can be met: port {self._port} answers in TLS alone, wanted --secure BUNDLE"
                return (
                    f"nobody can be met: port {self._port} is held by a program that does not answer on it; "
                    "choose another with --port or TRILINE_PORT"
                )
            time.sleep(0.02)
        return ""

    def close(self) -> None:
        """Withdraw everything and close the session; callbacks have ended when this returns.

        What was published before has been taken by all who listen: a connection that is closed while something has come
        over it that nobody has read yet is cut, and what the other end has not read is lost.
        """
        if self._publishers:
            with contextlib.suppress(zenoh.ZError):
                for _ in self._session.get(self.key(f"query/{TAKEN}"), target=zenoh.QueryTarget.ALL, timeout=TAKEN_S):
                    pass
        self._ended.set()
        with self._opening:
            pass  # a session that is being opened anew is closed here, too
        for closing in self._closing:
            closing.join(CLOSED_S)
        _withdraw(self._session, (*self._declared, *self._publishers.values()))
        self._declared.clear()
        self._publishers.clear()

    # ---- links that are gone

    def _declare(self, recipe: Recipe) -> Callable[[], None]:
        """Declare something, here and whenever the session is opened anew; returns a function that ends it."""
        with self._lock:
            self._recipes.append(recipe)
            self._declared.append(recipe(self._session, self._generation))

        def end() -> None:
            with self._lock:
                if recipe not in self._recipes or self._ended.is_set():
                    return
                place = self._recipes.index(recipe)
                del self._recipes[place]
                declared = self._declared.pop(place)
            declared.undeclare()

        return end

    def _hear_of_others(self, session: Any, generation: int) -> Any:
        """Subscribe to what other nodes say that they receive."""

        def take(sample: Any) -> None:
            if sample.kind != zenoh.SampleKind.PUT or generation != self._generation:
                return
            try:
                status = codec.parse("status/any", sample.payload.to_bytes())
                for row in status.topics:
                    if row.rate_hz > 0 and len(row.topic) < LONGEST_TOPIC:
                        self._links.told(row.topic, time.monotonic())
            except (ValueError, KeyError):  # those who want to know count it
                return

        return session.declare_subscriber(self.key("status/*"), zenoh.handlers.Callback(take, indirect=False))

    def _tell_taken(self, session: Any, _: int) -> Any:
        """Answer, without a word, in the thread that takes messages off the wire: after those that came before."""

        handler = zenoh.handlers.Callback(lambda query: query.drop(), indirect=False)
        return session.declare_queryable(self.key(f"query/{TAKEN}"), handler)

    def _watch_links(self) -> None:
        while not self._ended.wait(BEAT_S):
            try:
                peers = frozenset(str(peer) for peer in self._session.info.peers_zid())
                why = self._links.beat(time.monotonic(), peers)
                if why:
                    self._open_anew(why)
            except zenoh.ZError as error:  # it is tried again
                self.opened_anew.append(f"cannot be opened anew: {one_line(error)}")

    def open_anew(self, why: str) -> bool:
        """Take another session in place of one whose link carries nothing; False where none can be opened now."""
        try:
            self._open_anew(why, wait=False)
        except zenoh.ZError:
            return False
        return True

    def _open_anew(self, why: str, wait: bool = True) -> None:
        """Open another session, declare everything there, change over, and close the one before.

        A session with much to send over a link that is gone can take minutes to close: that is left to a thread, so
        that the links of the new one are watched meanwhile. With ``wait`` it begins a little later.
        """
        with self._opening:
            if self._ended.is_set():
                return
            session, generation = zenoh.open(configuration(self._port, self._file)), self._generation + 1
            with self._lock:
                old, withdrawn = self._session, (*self._declared, *self._publishers.values())
                declared = [recipe(session, generation) for recipe in self._recipes]
                publishers = {topic: self._declare_publisher(topic, session) for topic in self._publishers}
                self._session, self._generation = session, generation
                self._declared, self._publishers = declared, publishers
                for raw in list(self._latched):  # whoever joins later gets it from here
                    publishers[raw.topic].put(bytes(raw.data), attachment=pack(raw.envelope))
                self._links.opened(time.monotonic())
                self.opened_anew.append(why)
            closing = threading.Thread(target=self._close_old, args=(old, withdrawn, wait), daemon=True)
            self._closing = [thread for thread in self._closing if thread.is_alive()] + [closing]
            closing.start()

    def _close_old(self, old: Any, withdrawn: Iterable[Any], wait: bool) -> None:
        """Close a session that another one has replaced."""
        if wait:  # others are just learning of both sessions; one that is closed now can stay linked as a ghost
            self._ended.wait(BOTH_S)
        _withdraw(old, withdrawn)


def is_kept(topic: str) -> bool:
    """Whether what is said on a topic can be recalled."""
    return _kept(topics.find(topic)) > 0


def _kept(row: topics.Topic) -> int:
    """How many messages of a topic its publisher keeps."""
    if row.latched:
        return LATCHED_KEPT
    if not row.recorded or row.queue is topics.Queue.NEWEST:
        return 0
    return max(LEAST_KEPT, int(2.0 * KEPT_S * row.rate_hz))


def _withdraw(session: Any, declared: Iterable[Any]) -> None:
    for one in declared:
        with contextlib.suppress(zenoh.ZError):  # a link that has just broken takes its declarations along
            one.undeclare()
    with contextlib.suppress(zenoh.ZError):
        session.close()


def listen_elsewhere(
    endpoint: str, keys: Iterable[str], receive: Callable[[str, bytes], None]
) -> contextlib.AbstractContextManager[None]:
    """Hear what others publish on a Zenoh network that is not the bus; ends with the context.

    The session is a peer that connects to ``endpoint`` (``tcp/127.0.0.1:7447``), again and again, and links directly
    with those it learns of there.

    Parameters
    ----------
    endpoint : of a router or a peer
    keys : key expressions
    receive : called with the key and the payload of each sample, in the thread that takes them off the wire

    Raises
    ------
    UserError : an endpoint or a key expression that Zenoh refuses
    """

    @contextlib.contextmanager
    def open_session() -> Iterator[None]:
        zenoh.init_log_from_env_or("off")
        config = zenoh.Config()
        for key, value in {
            "mode": "peer",
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": True,
            "listen/endpoints": ["tcp/127.0.0.1:0"],
            "connect/endpoints": [endpoint],
            "connect/timeout_ms": -1,
            "connect/exit_on_failure": False,
            "connect/retry": _RETRY,
            "transport/shared_memory/enabled": False,
        }.items():
            try:
                config.insert_json5(key, json.dumps(value))
            except zenoh.ZError as error:
                raise UserError(f"{endpoint}: not a Zenoh endpoint: {one_line(error)}") from None

        def take(sample: Any) -> None:
            if sample.kind == zenoh.SampleKind.PUT:
                receive(str(sample.key_expr), sample.payload.to_bytes())

        try:
            with zenoh.open(config) as session:
                subscribers = [
                    session.declare_subscriber(key, zenoh.handlers.Callback(take, indirect=False)) for key in keys
                ]
                yield
                for subscriber in subscribers:
                    subscriber.undeclare()
        except zenoh.ZError as error:
            raise UserError(f"{endpoint}: {one_line(error)}") from None

    return open_session()


@contextlib.contextmanager
def routing(file: Path, port: int | None = None) -> Iterator[Callable[[], int]]:
    """A Zenoh router by a configuration file, as long as the context; gives a function that counts who is linked.

    Parameters
    ----------
    file : of the configuration
    port : listen there instead

    Raises
    ------
    UserError : a file that is no configuration of a router, or an address at which it cannot listen
    """
    zenoh.init_log_from_env_or("off")
    config = configuration(file=file)
    if json.loads(config.get_json("mode")) != "router":
        raise UserError(f"{file}: not the configuration of a router")
    config.insert_json5("listen/endpoints", json.dumps(_router_endpoints(config, port)))
    try:
        session = zenoh.open(config)
    except zenoh.ZError as error:
        raise UserError(f"the router cannot listen: {one_line(error)}") from None

    def here(query: Any) -> None:
        with query:
            query.reply(query.key_expr, b"", attachment=pack(Envelope(0, "router", 0)))

    session.declare_queryable(topics.key_expression("*", f"query/{LINK}"), zenoh.handlers.Callback(here))
    try:
        yield lambda: len(session.info.transports())  # aircraft and desks are clients
    finally:
        with contextlib.suppress(zenoh.ZError):  # where it has not come to listen, the time to close is over
            session.close()


def _parameters(text: str) -> list[tuple[str, str]]:
    return [(key, value) for key, _, value in (part.partition("=") for part in text.split(";") if part)]
