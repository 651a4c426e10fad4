"""What comes down from an aircraft, in what order and how fast; what a recorder finds again; what the ground lacks."""

from __future__ import annotations

import random

import numpy as np
import pytest
import sample_messages as sample

from triline.nodes.bus.downlink import (
    FIRST,
    GAPS,
    INVENTORY,
    LAST,
    MOST_ASKED,
    MOST_RUNS,
    PATIENCE_S,
    SECOND,
    THUMBNAIL,
    Meter,
    Waiting,
    asked,
    cost,
    for_the_link,
    share_of,
)
from triline.nodes.errors import UserError
from triline.nodes.recorder.ground import AircraftRecorder, Gap, Ground, Numbers, portion
from triline.nodes.recorder.recorder import Recorder
from triline.nodes.recording.reader import RecordingReader
from triline.nodes.recording.reread import Stream
from triline.nodes.recording.summary import topic_summaries
from triline.nodes.router.router import OnBoardRouter
from triline.schemas import codec, topics
from triline.schemas import messages as m
from triline.schemas.envelope import Envelope, RawMessage

#: What is too much for a radio link, or nobody needs on the ground in flight.
STAYS = {"sensor/imu", "sensor/attitude", "sensor/lines/*", "observation/progress", "adjustment/pace", "matching/pace",
         "truth/trajectory", "truth/point", "truth/world"}  # fmt: skip


def raw(topic: str, number: int, data: bytes | None = None, start: int = 7) -> RawMessage:
    data = codec.encode(sample.body(topic)) if data is None else data
    return RawMessage(topic, Envelope(number * 5_000_000, "node", number, start), data, number + 1)


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def test_every_topic_comes_down_or_stays_on_board_on_purpose():
    names = {row.name for row in topics.TOPICS}
    assert {name for name in names if share_of(name) is None} == STAYS
    assert share_of("status/adjuster") is share_of("status/*") and share_of("sensor/lines/F") is None
    assert share_of("orientation/final").every == 1  # all that is lossless of the result comes


def test_no_more_bytes_pass_than_the_limit_and_earlier_turns_go_first():
    clock = Clock()
    meter = Meter(1000.0, clock)
    for _ in range(600):  # one hundred seconds of somebody who always has more to say
        while meter.wait_s(LAST) == 0.0:
            meter.spend(130)
        clock.now += 1.0 / 6.0
    assert 99_000 <= meter.passed <= 101_000
    meter._waiting[FIRST] += 1  # somebody of an earlier turn waits
    clock.now += 10.0
    assert meter.wait_s(SECOND) == float("inf") and meter.wait_s(FIRST) == 0.0
    assert not meter.let_pass(10, GAPS, lambda: True)
    assert Meter(0.0, clock).wait_s(LAST) == 0.0


def test_what_waits_goes_by_turn_and_what_waited_too_long_is_left_out():
    clock = Clock()
    waiting = Waiting(clock)
    waiting.put(raw("point/object", 1), LAST)
    waiting.put(raw("orientation/final", 2), SECOND)
    waiting.put(raw("configuration/project", 3), FIRST)
    clock.now += PATIENCE_S + 0.1
    waiting.put(raw("orientation/final", 4), SECOND)
    order = [found[0].envelope.sequence for found in iter(lambda: waiting.take(0.0), None)]
    assert order == [3, 4] and waiting.left_out == 2  # what is latched stays


def test_a_router_thins_out_by_numbers_and_lets_images_on_board():
    router = OnBoardRouter()
    router.linked = True
    for number in range(40):
        for topic in ("orientation/live", "orientation/final", "sensor/lines/F", "sensor/attitude"):
            router.take(raw(topic, number, b"x"))
    sent = [found[0] for found in iter(lambda: router.waiting.take(0.0), None)]
    assert [r.envelope.sequence for r in sent if r.topic == "orientation/live"] == [0, 20]
    assert [r.envelope.sequence for r in sent if r.topic == "orientation/final"] == list(range(40))
    assert len(sent) == 42
    with pytest.raises(ValueError, match="stays on board"):
        parameters = {"topic": "sensor/lines/F", "source": "s", "start": "1", "runs": "0-5", "every": "1"}
        list(router.answer(None, "recorded", parameters))  # nobody is asked
    with pytest.raises(ValueError, match="bytes_s"):
        OnBoardRouter(-1.0)


def test_that_a_node_stops_comes_down_whatever_its_number():
    router = OnBoardRouter()
    router.linked = True
    for number, state in enumerate(("running", "running", "stopping")):
        router.take(raw("status/matcher", number, codec.encode(m.NodeStatus(node="matcher", state=state))))
    router.take(raw("status/matcher", 3, b"\xff\xff"))
    sent = [found[0] for found in iter(lambda: router.waiting.take(0.0), None)]
    assert [r.envelope.sequence for r in sent] == [0, 2]


def test_tiles_come_down_small_with_the_means_of_what_is_known():
    size = 4 * THUMBNAIL
    grey = np.zeros((size, size), dtype=np.uint8)
    grey[:4, :4] = 100
    grey[4:6, :4] = 60  # half of a cell is known
    tile = m.GroundTile(size=size, gsd_m=0.5, x=10.0, y=20.0, encoding="mono8", data=grey.tobytes())
    small = for_the_link(raw("orthoimage/live", 1, codec.encode(tile)))
    body = codec.decode("orthoimage/live", small.data)
    assert (body.size, body.gsd_m, body.x, body.y) == (THUMBNAIL, 2.0, 10.0, 20.0)
    cells = np.frombuffer(body.data, dtype=np.uint8).reshape(THUMBNAIL, THUMBNAIL)
    assert cells[0, 0] == 100 and cells[1, 0] == 60 and not cells[2:].any() and cost(small) < 1500
    with pytest.raises(ValueError, match="in a tile"):
        for_the_link(raw("orthoimage/live", 1, codec.encode(m.GroundTile(size=9, encoding="mono8", data=b"1"))))


def test_problems_of_a_status_come_down_in_short():
    """Each counter tells its last problem, of up to 5000 characters: some would take a thin link for seconds."""
    status = m.NodeStatus(node="matcher", state="running", last_problem="7" * 5000)
    for name in ("late", "malformed", "second voice"):
        status.counters.add(name=name, value=3, last_problem=name + ": " + "9" * 5000)
    small = for_the_link(raw("status/matcher", 4, codec.encode(status)))
    body = codec.decode("status/matcher", small.data)
    assert cost(small) < 1500 and [c.value for c in body.counters] == [3, 3, 3]
    assert [c.last_problem[: len(c.name)] for c in body.counters] == ["late", "malformed", "second voice"]
    usual = raw("status/matcher", 8, codec.encode(m.NodeStatus(node="matcher", last_problem="sensor/gnss 7: empty")))
    assert for_the_link(usual) is usual
    with pytest.raises(ValueError):
        for_the_link(raw("status/matcher", 12, b"\xff" * 2000))


def test_questions_that_make_no_sense_are_refused():
    good = {"topic": "event/log", "source": "s", "start": "5", "runs": "1-4,9-9", "every": "1"}
    assert asked(good).runs == [(1, 4), (9, 9)]
    for key, value in (("runs", "a-b"), ("runs", ""), ("every", "0"), ("start", "x"), ("runs", f"0-{2 * MOST_ASKED}"),
                       ("runs", ",".join(["1-1"] * (MOST_RUNS + 1)))):  # fmt: skip
        with pytest.raises(ValueError, match="wanted"):
            asked(good | {key: value})
    with pytest.raises(ValueError, match="wanted"):
        asked({})


@pytest.mark.parametrize("seed", range(20))
def test_runs_of_numbers_are_the_set_of_them(seed):
    rng = random.Random(seed)
    numbers, there = Numbers(), set()
    for _ in range(60):
        first = rng.randrange(80)
        last = first + rng.choice((0, 0, 0, 1, 5, 20))
        new = set(range(first, last + 1)) - there
        assert numbers.add_run(first, last) == len(new)
        there |= new
        a = rng.randrange(90)
        b = a + rng.randrange(30)
        missing = {n for x, y in numbers.missing(a, b) for n in range(x, y + 1)}
        assert missing == set(range(a, b + 1)) - there


def test_questions_have_room_for_so_many_runs_and_messages():
    runs = [(10 * k, 10 * k + 3) for k in range(200)]
    parts = []
    while runs:
        part, runs = portion(runs)
        assert len(part) <= MOST_RUNS and sum(b - a + 1 for a, b in part) <= MOST_ASKED
        parts += part
    assert [n for a, b in parts for n in range(a, b + 1)] == [10 * k + i for k in range(200) for i in range(4)]
    part, rest = portion([(0, 3 * MOST_ASKED)])
    assert part == [(0, MOST_ASKED - 1)] and rest == [(MOST_ASKED, 3 * MOST_ASKED)]


@pytest.mark.parametrize("compression", ["none", "zstd"])
def test_a_recorder_finds_again_what_it_has_written(tmp_path, compression):
    recorder = Recorder(str(tmp_path / "a.mcap"), compression, rotate_mb=0.05)
    recorder.start()
    said = [raw(topic, n, bytes([n % 251]) * 400) for n in range(300) for topic in ("event/log", "orientation/live")]
    for k in range(0, len(said), 20):
        recorder.take(said[k : k + 20])
        recorder._flushed_s = 0.0  # it is time to close a chunk
        recorder.tend()
    assert compression == "zstd" or len(recorder.files) > 2
    inventory = m.Inventory.FromString(recorder.inventory({})[0].data)
    assert [(s.topic, s.first, s.last) for s in inventory.streams] == [
        ("event/log", 0, 299),
        ("orientation/live", 0, 299),
    ]
    found = recorder._reread.read(Stream("event/log", "node", 7), [(5, 8), (100, 131)], 5)
    assert [r.envelope.sequence for r in found] == [5, *range(100, 131, 5)]
    assert found == [r for r in said if r.topic == "event/log" and r in found]
    question = {"topic": "event/log", "source": "node", "start": "7", "runs": "0-299", "every": "1"}
    answer = recorder.recorded(question)
    assert len(answer) == 301 and answer[-1].topic == INVENTORY
    assert recorder.recorded(question | {"source": "nobody"})[:-1] == []
    recorder.files[0].unlink()  # moved away
    assert 0 < len(recorder.recorded(question)) < 301 or compression == "zstd"
    recorder.close()


def inventory(first: int, last: int) -> m.Inventory:
    body = m.Inventory()
    for topic in ("orientation/final", "adjustment/report", "status/node", "sensor/lines/F"):
        body.streams.add(topic=topic, source="node", start=7, first=first, last=last)
    return body


def test_the_ground_asks_for_what_it_lacks_and_records_it_once(tmp_path):
    aircraft = AircraftRecorder("a1", str(tmp_path / "a1.mcap"))
    aircraft.start()
    for number in (0, 1, 2, 5, 6, 6):
        aircraft.receive(raw("orientation/final", number))
    aircraft.receive(raw("adjustment/report", 0))
    assert aircraft.lacks(inventory(0, 20)) == []  # what has just been written may be on its way
    assert aircraft.missing == 16 + 4
    report, final = aircraft.lacks(inventory(0, 22))
    assert (report.stream.topic, report.runs) == ("adjustment/report", [(1, 4)])  # every fifth
    assert (final.stream.topic, final.runs) == ("orientation/final", [(3, 4), (7, 20)])
    # the link cuts the answer after 10; 8 is not on board either
    rest = aircraft.fill([raw("orientation/final", n) for n in (3, 4, 7, 9, 10)], final, whole=False)
    assert rest == [(11, 20)]
    assert aircraft.fill([], Gap(final.stream, final.share, rest), whole=False) == rest  # the link is gone
    assert (
        aircraft.fill(
            [raw("orientation/final", n) for n in range(11, 21)], Gap(*[final.stream, final.share, rest]), True
        )
        == []
    )
    assert aircraft.fill([raw("adjustment/report", n) for n in (5, 10, 15, 20)], report, whole=True) == []
    assert aircraft.lacks(inventory(0, 22))[0].runs == [(21, 22)] and aircraft.filled == 19
    aircraft.close()
    reader = RecordingReader(tmp_path / "a1.mcap")
    numbers = [r.envelope.sequence for r in reader.raws(reader.select(["orientation/final"]))]
    assert sorted(numbers) == [n for n in range(21) if n != 8]
    gaps = {row.topic: row.gaps for row in topic_summaries(reader)}
    assert gaps == {"orientation/final": 1, "adjustment/report": 0}


def test_names_of_platforms_that_come_over_the_link_make_no_files_elsewhere(tmp_path):
    ground = Ground(str(tmp_path), whole="trajectory/filtered")
    for name in ("../evil", "a b", "", "x" * 65, "fleet"):
        assert ground.recorder_of(name) is None
    made = ground.recorder_of("a1")
    assert made is not None and made is ground.recorder_of("a1") and made.every("trajectory/filtered") == 1
    made.close()
    assert [path.name for path in tmp_path.iterdir()] == ["a1.mcap"]
    for whole in ("nonsense", "observation/progress"):
        with pytest.raises(ValueError, match="whole"):
            Ground(str(tmp_path), whole=whole)
    with pytest.raises(UserError):
        Ground(str(tmp_path), compression="none").recorder_of("a1") and AircraftRecorder("b", str(tmp_path)).start()
