"""Order and checks of message streams, without a bus."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from triline.nodes.ordering import MAX_JUMP_NS, REBASE_AFTER, Sequencer, StreamCheck, is_orderly, order_key
from triline.nodes.rectifier.rectifier import Rectifier
from triline.schemas import topics
from triline.schemas.envelope import Envelope

MS = 1_000_000
INPUTS = ("sensor/attitude", "sensor/gnss", "trajectory/filtered", "observation/tie", "configuration/strip")
TOPICS = st.sampled_from(("sensor/attitude", "sensor/gnss", "trajectory/filtered", "observation/tie"))


def lateness_ns(topic: str) -> int:
    return round(topics.find(topic).allowed_lateness_ms * MS)


@st.composite
def arrivals(draw, within: float = 1.0):
    """Messages (topic, envelope) in an order of arrival with jitter up to ``within`` times the allowed lateness.

    A topic has one source, or two that have been heard before.
    """
    n = draw(st.integers(1, 60))
    sources = draw(st.sampled_from(("a", "ab")))
    last: dict[tuple[str, str], tuple[int, int]] = {}
    timed = []
    stamp = 10**18
    if len(sources) > 1:
        for place, (topic, source) in enumerate(itertools.product(INPUTS[:4], sources)):
            last[topic, source] = (0, stamp + place)
            timed.append((stamp + place, 0, topic, Envelope(stamp + place, source, 0)))
        stamp += place
    for _ in range(n):
        stamp += draw(st.sampled_from((0, 0, 1, 5, 20, 60, 300))) * MS
        topic, source = draw(TOPICS), draw(st.sampled_from(sources))
        sequence, arrived = last.get((topic, source), (-1, 0))
        arrived = max(arrived, stamp + int(draw(st.floats(0, within)) * lateness_ns(topic)))
        last[topic, source] = sequence + 1, arrived
        timed.append((arrived, draw(st.integers(0, 9)), topic, Envelope(stamp, source, sequence + 1)))
    # What arrives at one instant comes in any order, but messages of one stream keep theirs.
    taken = sorted(timed, key=lambda entry: entry[:2])
    streams = {stream: iter([e for e in timed if (e[2], e[3].source) == stream]) for stream in last}
    return [next(streams[entry[2], entry[3].source])[2:] for entry in taken]


def run(messages, step_s: float = 10.0, **options):
    """What leaves a Sequencer, with what was called late; the clock goes on by ``step_s`` with every message."""
    sequencer: Sequencer = Sequencer(INPUTS, **options)
    out, late = [], []
    for i, (topic, envelope) in enumerate(messages):
        item = (topic, envelope)
        returned = sequencer.push(topic, envelope, item, i * step_s)
        if returned is not None:
            late.append(returned)
            out.append(returned)
        out += sequencer.pop(i * step_s)
    out += sequencer.flush()
    return out, late


@given(arrivals())
@settings(max_examples=150, deadline=None, derandomize=True, database=None)
def test_jitter_inside_the_allowed_lateness_does_not_change_the_order(messages):
    out, late = run(messages)
    assert not late
    assert out == sorted(messages, key=lambda m: order_key(*m))


@given(arrivals(within=20.0))
@settings(max_examples=100, deadline=None, derandomize=True, database=None)
def test_every_message_leaves_once_whatever_the_jitter(messages):
    out, late = run(messages)
    assert sorted(out) == sorted(messages)
    # What was not late is in order.
    on_time = [m for m in out if m not in late]
    assert on_time == sorted(on_time, key=lambda m: order_key(*m))


def test_a_message_after_its_turn_leaves_at_once_and_is_late():
    early = [("sensor/attitude", Envelope(t * MS, "a", i)) for i, t in enumerate((0, 100, 500))]
    out, late = run([*early, ("sensor/gnss", Envelope(50 * MS, "a", 0))])
    assert late == [("sensor/gnss", Envelope(50 * MS, "a", 0))]
    assert out.index(late[0]) < out.index(early[2])


def test_a_machine_that_hesitates_does_not_make_a_steady_stream_late():
    """The trajectory stands still for 2 s of platform time that pass within 0.1 s of waiting."""
    fixes = [("sensor/gnss", Envelope(t * MS, "s", i)) for i, t in enumerate(range(0, 2000, 20))]
    poses = [("trajectory/filtered", Envelope(t * MS, "n", i)) for i, t in enumerate(range(0, 2000, 5))]
    first = poses[:1]
    out, late = run([*first, *fixes, *poses[1:]], step_s=0.001)
    assert not late
    assert out == sorted([*poses, *fixes], key=lambda m: order_key(*m))
    _, late = run([*first, *fixes, *poses[1:]], step_s=0.001, grace_s=0.0)
    assert len(late) > 300  # the same without patience


def test_an_observation_that_is_stamped_ahead_makes_nothing_else_late():
    """Ties are stamped a second ahead of the poses; a strip that arrives 30 ms late still comes before its poses."""
    poses = [("trajectory/filtered", Envelope(t * MS, "n", i)) for i, t in enumerate(range(0, 2000, 5))]
    ties = [("observation/tie", Envelope((t + 1000) * MS, "m", i)) for i, t in enumerate(range(0, 1000, 20))]
    strip = ("configuration/strip", Envelope(500 * MS, "s", 0))
    arriving = sorted([*poses, *ties], key=lambda m: m[1].stamp_ns - (1000 * MS if m[0] == "observation/tie" else 0))
    at = next(i for i, (topic, e) in enumerate(arriving) if topic == "trajectory/filtered" and e.stamp_ns == 530 * MS)
    arriving.insert(at, strip)
    out, late = run(arriving, step_s=0.01)
    assert not late
    assert out == sorted(arriving, key=lambda m: order_key(*m))


def test_a_steady_stream_that_has_died_holds_nothing_for_longer_than_its_grace():
    sequencer: Sequencer = Sequencer(("trajectory/filtered", "observation/tie"), grace_s=0.5)
    sequencer.push("trajectory/filtered", Envelope(0, "n", 0), "pose", 0.0)
    for i in range(1, 20):
        sequencer.push("observation/tie", Envelope(i * 100 * MS, "s", i), i, 0.01 * i)
    assert sequencer.pop(0.4) == ["pose"]
    assert sequencer.pop(0.6) == list(range(1, 18))  # all that is older than the allowed lateness of 100 ms


def test_reports_of_a_busy_adjuster_come_in_order_and_rare_ones_hold_nothing_up():
    """The adjuster is 1.5 s behind. It is silent on reports, then, in a turn, on the live orientation."""
    begin = 10**18
    inputs = ("trajectory/filtered", "orientation/live", "adjustment/report")
    poses = [(t, "trajectory/filtered", Envelope(begin + t * MS, "n", t // 5)) for t in range(0, 8000, 5)]
    live = [(t + 1500, "orientation/live", Envelope(begin + t * MS, "a", t // 50)) for t in range(0, 3000, 50)]
    told = (*range(0, 1000, 200), *range(3000, 6000, 200))
    reports = [(t + 1500, "adjustment/report", Envelope(begin + t * MS, "a", i)) for i, t in enumerate(told)]
    arriving = sorted([*poses, *live, *reports], key=lambda m: (m[0], m[1]))
    assert arriving[0][1] == "trajectory/filtered"
    sequencer: Sequencer = Sequencer(inputs)
    for _, topic, envelope in (reports[0], live[0]):  # heard at once, as when all began together
        sequencer.push(topic, envelope, (topic, envelope), 0.0)
    out, late, waited = [], [], {}
    for at, topic, envelope in arriving:
        if (topic, envelope.sequence) in (("orientation/live", 0), ("adjustment/report", 0)):
            continue
        late += filter(None, [sequencer.push(topic, envelope, (topic, envelope), at * 1e-3)])
        for item in sequencer.pop(at * 1e-3):
            out.append(item)
            waited[item] = at - (item[1].stamp_ns - begin) / MS
    assert not late
    assert out == sorted(out, key=lambda m: order_key(*m))
    assert sum(topic == "adjustment/report" for topic, _ in out) == len(told)
    assert max(w for (_, e), w in waited.items() if e.stamp_ns < begin + 2900 * MS) < 1600  # no longer than for live


def test_two_updates_with_one_stamp_are_not_late():
    """A strip is over, and the adjuster is silent on what is live; the second update's points come after the report of
    the first."""
    begin = 10**18
    sequencer: Sequencer = Sequencer(Rectifier.inputs)
    lines = [(t, "sensor/lines/N", Envelope(begin + t * MS, "s", t // 50)) for t in range(0, 6000, 50)]
    told = [(t + 20, "orientation/live", Envelope(begin + t * MS, "a", t // 50)) for t in range(0, 1000, 50)]
    for n, t in enumerate(range(0, 4000, 200)):
        for k in (2 * n, 2 * n + 1):  # an update takes 70 ms; after the strip they come 1.5 s late
            at = t + (20 if t < 1000 else 1500) + 70 * (k % 2)
            told += [(at, name, Envelope(begin + t * MS, "a", k)) for name in ("point/object", "adjustment/report")]
    late, out = [], []
    for at, name, envelope in sorted(told + lines, key=lambda m: m[0]):
        late += filter(None, [sequencer.push(name, envelope, (name, envelope), at * 1e-3)])
        out += sequencer.pop(at * 1e-3)
    assert not late and len(out) > 100
    assert [envelope.stamp_ns for _, envelope in out] == sorted(envelope.stamp_ns for _, envelope in out)


@pytest.mark.parametrize("topic", ["orientation/final", "point/object"])
def test_the_orthoimage_may_get_the_end_of_a_strip_two_seconds_late(topic):
    """The adjuster has flown a strip and is silent on what is live; what became final at its end comes later."""
    begin = 10**18
    lines = [(t, "sensor/lines/N", Envelope(begin + t * MS, "s", t // 50)) for t in range(0, 8000, 50)]
    live = [(t + 20, "orientation/live", Envelope(begin + t * MS, "a", t // 50)) for t in range(0, 3000, 50)]
    for behind, lost in ((1900, False), (3500, True)):
        told = [
            (t + (20 if t < 3000 else behind), topic, Envelope(begin + t * MS, "a", t // 50))
            for t in range(0, 4000, 50)
        ]
        sequencer: Sequencer = Sequencer(Rectifier.inputs)
        late = []
        for at, name, envelope in sorted([*lines, *live, *told], key=lambda m: (m[0], m[1])):
            late += filter(None, [sequencer.push(name, envelope, (name, envelope), at * 1e-3)])
            sequencer.pop(at * 1e-3)
        assert bool(late) == lost


def test_the_last_words_of_a_node_that_ends_are_not_late():
    """Everything was worked off for lack of news; the navigator ends and says its last smoothed poses."""
    sequencer: Sequencer = Sequencer(("trajectory/smoothed", "orientation/live"))
    for t in (100, 200):
        sequencer.push("orientation/live", Envelope(t * MS, "a", t), f"live {t}", 0.0)
    assert sequencer.flush() == ["live 100", "live 200"]
    assert sequencer.push("trajectory/smoothed", Envelope(200 * MS, "n", 1), "last", 3.0) is None
    assert sequencer.flush() == ["last"]
    assert sequencer.push("trajectory/smoothed", Envelope(150 * MS, "m", 1), "too late", 3.0) == "too late"


ADJUSTER = (
    "configuration/strip", "trajectory/filtered", "trajectory/smoothed", "observation/control", "observation/verdict",
    "observation/tie", "observation/progress",
)  # fmt: skip


def held(messages, inputs):
    """Platform time, ms, for which each message is held that leaves; waiting time goes with it."""
    sequencer: Sequencer = Sequencer(inputs)
    waited, late = {}, []
    for topic, envelope in messages:
        now = envelope.stamp_ns / 1e9
        late += filter(None, [sequencer.push(topic, envelope, (topic, envelope), now)])
        for left in sequencer.pop(now):
            waited[left] = (envelope.stamp_ns - left[1].stamp_ns) / MS
    assert not late
    return waited


def stream(topic, source, times_ms):
    return [(topic, Envelope(t * MS, source, i)) for i, t in enumerate(times_ms)]


def test_who_is_not_there_holds_nothing_up():
    """Without matcher, without verdicts and with control that was sent long ago a tie waits for the next pose alone."""
    ground = stream("configuration/strip", "s", [0]) + stream("observation/control", "s", [0])
    poses, ties = (
        stream("trajectory/filtered", "n", range(1, 6000, 5)),
        stream("observation/tie", "s", range(3, 6000, 7)),
    )
    smoothed = stream("trajectory/smoothed", "n", [1] * 5)
    waited = held(sorted([*ground, *poses, *smoothed, *ties], key=lambda m: order_key(*m)), ADJUSTER)
    later = [w for (topic, e), w in waited.items() if topic == "observation/tie" and e.stamp_ns > 1000 * MS]
    assert len(later) > 700 and max(later) <= 5
    later = [w for (topic, e), w in waited.items() if topic == "trajectory/filtered" and e.stamp_ns > 1000 * MS]
    assert len(later) > 900 and max(later) <= 7


def test_a_matcher_is_waited_for_while_it_speaks_and_for_its_grace():
    """It is a second behind, its words are stamped 0.8 s ahead, its first tie comes after them; it dies at 2 s."""
    poses = [(m[1].stamp_ns / MS, m) for m in stream("trajectory/filtered", "n", range(0, 9000, 5))]
    words = [(m[1].stamp_ns / MS + 200, m) for m in stream("observation/progress", "m", range(800, 1800, 40))]
    ties = [(m[1].stamp_ns / MS + 200, m) for m in stream("observation/tie", "m", range(1220, 1800, 40))]
    sequencer: Sequencer = Sequencer(("trajectory/filtered", "observation/tie", "observation/progress"))
    out = []
    for at, (topic, envelope) in sorted([*poses, *words, *ties], key=lambda m: (m[0], order_key(*m[1]))):
        # its first words are about the time before it was heard, which the poses have passed: they are not late
        assert sequencer.push(topic, envelope, (at, topic, envelope), at / 1e3) is None
        out += [(at, topic, envelope) for _, topic, envelope in sequencer.pop(at / 1e3)]
    assert {topic for _, topic, _ in out} == {"trajectory/filtered", "observation/tie"}  # words on progress end here
    assert sum(topic == "observation/tie" for _, topic, _ in out) == len(ties)
    of_poses = [(at, at - e.stamp_ns / MS) for at, topic, e in out if topic == "trajectory/filtered"]
    assert max(w for at, w in of_poses if at > 5100) <= 50  # it tells nothing any more: 50 ms for its ties
    assert max(w for at, w in of_poses) > 2900


def test_equal_stamps_leave_by_their_place_in_the_topic_table():
    names = ("observation/tie", "trajectory/filtered", "sensor/gnss", "configuration/strip")
    messages = [(name, Envelope(10**9, "x", 0)) for name in names]
    for permutation in itertools.permutations(messages):
        out, late = run(permutation)
        assert [topic for topic, _ in out] == list(reversed(names))
        assert not late


def test_one_stream_needs_no_other_to_come_first():
    sequencer: Sequencer = Sequencer(("sensor/gnss",))
    assert sequencer.push("sensor/gnss", Envelope(10**9, "a", 0), "m", 0.0) is None
    assert sequencer.pop(0.0) == ["m"]


# ---- checks of one stream


#: The longest jump that is believed at once.
JUMP_MS = MAX_JUMP_NS // MS


def accept(check, sequence, stamp_ms, topic="sensor/gnss", source="a", start=0):
    return check.accept(topic, Envelope(stamp_ms * MS, source, sequence, start), (sequence, stamp_ms))


@pytest.fixture
def check():
    return StreamCheck()


def test_gaps_are_counted_and_filled_by_what_comes_out_of_order(check):
    for sequence in (5, 6, 9):
        assert accept(check, sequence, sequence)
    counts = check.counts["sensor/gnss"]
    assert (counts.received, counts.gaps, counts.duplicates) == (3, 2, 0)
    assert accept(check, 7, 7) == [(7, 7)]
    assert (counts.gaps, counts.duplicates) == (1, 0)
    assert accept(check, 7, 7) == []
    assert (counts.gaps, counts.duplicates) == (1, 1)


def test_duplicates_are_dropped_and_a_restart_is_none(check):
    assert accept(check, 0, 0)
    assert accept(check, 0, 0) == []
    assert accept(check, 0, 10, start=1) == [(0, 10)]
    assert check.counts["sensor/gnss"].duplicates == 1


def test_time_that_goes_backwards_is_dropped(check):
    kinds = []
    check = StreamCheck(lambda kind, text: kinds.append((kind, text)))
    accept(check, 0, 1000)
    assert accept(check, 1, 400) == []
    assert accept(check, 2, 1200) == [(2, 1200)]
    assert check.counts["sensor/gnss"].malformed == 1
    assert kinds == [("malformed", "sensor/gnss 1 of 'a': time goes back by 0.6 s")]


def test_a_clock_that_was_set_back_is_believed_after_a_while(check):
    accept(check, 0, 100_000)
    taken = [bool(accept(check, 1 + i, 10 * i)) for i in range(REBASE_AFTER + 3)]
    assert taken == [False] * (REBASE_AFTER - 1) + [True] * 4
    assert check.counts["sensor/gnss"].malformed == REBASE_AFTER - 1


def test_one_stamp_far_ahead_is_dropped_and_poisons_nothing(check):
    accept(check, 0, 0)
    far = 2 * MAX_JUMP_NS // MS
    assert accept(check, 1, far) == []
    assert accept(check, 2, 400) == [(2, 400)]
    assert accept(check, 3, 600) == [(3, 600)]
    assert check.counts["sensor/gnss"].malformed == 1


def test_a_true_pause_loses_nothing(check):
    accept(check, 0, 0)
    far = 2 * MAX_JUMP_NS // MS
    assert accept(check, 1, far) == []
    assert accept(check, 2, far + 200) == [(1, far), (2, far + 200)]
    assert accept(check, 3, far + 400) == [(3, far + 400)]
    assert check.counts["sensor/gnss"].malformed == 0


def test_latched_topics_may_come_again_with_any_stamp(check):
    assert accept(check, 0, 500, topic="observation/control")
    assert accept(check, 1, 100, topic="observation/control")
    assert check.counts["observation/control"].malformed == 0


@given(st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 12), st.integers(0, 200_000)), max_size=60))
@settings(max_examples=200, deadline=None, derandomize=True, database=None)
def test_the_verdict_on_a_stream_does_not_depend_on_the_others(messages):
    mixed = StreamCheck()
    together = {s: [] for s in "abc"}
    for source, sequence, stamp in messages:
        together[source] += accept(mixed, sequence, stamp, source=source)
    for source in "abc":
        alone = StreamCheck()
        passed = [m for s, q, t in messages if s == source for m in accept(alone, q, t, source=source)]
        assert passed == together[source]


@given(st.lists(st.tuples(st.integers(0, 30), st.integers(0, 200_000)), max_size=60))
@settings(max_examples=200, deadline=None, derandomize=True, database=None)
def test_no_message_passes_twice(messages):
    check = StreamCheck()
    passed = [m for q, t in messages for m in accept(check, q, t)]
    assert len({sequence for sequence, _ in passed}) == len(passed)


@given(
    st.lists(st.tuples(st.sampled_from([0, 1, 1, 1, 1, 3]), st.sampled_from([-1, 0, 5, 5, JUMP_MS, JUMP_MS + 1]))),
    st.sampled_from(["sensor/gnss", "observation/control", "trajectory/smoothed"]),
)
@settings(max_examples=300, deadline=None, derandomize=True, database=None)
def test_a_stream_is_orderly_only_if_every_message_passes_at_once(steps, topic):
    sequence = np.cumsum([0, *(n for n, _ in steps)])
    stamp_ms = 1000 + np.cumsum([0, *(t for _, t in steps)])
    check = StreamCheck()
    messages = list(zip(sequence.tolist(), stamp_ms.tolist(), strict=True))
    passed = [accept(check, *message, topic=topic) == [message] for message in messages]
    if is_orderly(topic, sequence, stamp_ms * MS):
        assert all(passed)
    elif topic == "sensor/gnss":
        assert not all(passed)


# ---- numbers and clocks of somebody else


def checked(numbers, topic="sensor/gnss"):
    problems: list = []
    check: StreamCheck = StreamCheck(lambda kind, text: problems.append((kind, text)))
    passed = []
    for i, number in enumerate(numbers):
        passed += check.accept(topic, Envelope(10**18 + i * 200 * MS, "a", number), number)
    return passed, check.counts[topic], problems


def test_two_messages_in_anothers_name_with_numbers_far_ahead_cost_nobody_else_a_message():
    own = list(range(300))
    passed, counts, problems = checked([*own[:100], 1_000_100, 1_000_101, *own[100:]])
    assert passed == own
    assert counts.malformed == 2 and counts.duplicates == 0 and counts.gaps == 0
    assert "jump ahead by 1000001" in problems[0][1]


def test_two_messages_within_the_bound_cost_none_either():
    own = list(range(300))
    passed, counts, _ = checked([*own[:100], 9_000, 9_001, *own[100:]])
    assert [n for n in passed if n < 1000] == own and counts.duplicates == 0


def test_a_long_loss_is_believed_and_nothing_after_it_is_lost():
    after = list(range(500_000, 500_050))
    passed, counts, problems = checked([*range(10), *after])
    assert passed == [*range(10), *after]
    assert counts.gaps == 500_000 - 10 and counts.malformed == 0 and not problems
    assert not is_orderly("sensor/gnss", np.array([0, 1, 500_000]), 10**18 + np.arange(3) * MS)


def fed(sequencer, stamps):
    """What leaves a sequencer that is fed (topic, source, seconds), all of it within no waiting time."""
    numbers: dict = {}
    out = []
    for topic, source, seconds in stamps:
        n = numbers[topic, source] = numbers.get((topic, source), -1) + 1
        late = sequencer.push(topic, Envelope(10**18 + round(seconds * 1e9), source, n), (topic, seconds), 0.0)
        out += [] if late is None else [late]
        out += sequencer.pop(100.0)
    return out


@pytest.mark.parametrize("topic", ["trajectory/filtered", "sensor/gnss"])
def test_one_stamp_an_hour_ahead_does_not_move_the_time_of_the_platform(topic):
    sequencer: Sequencer = Sequencer(INPUTS)
    messages = [("sensor/attitude", "a", 0.005 * i) for i in range(400)]
    messages.insert(200, (topic, "forged", 3600.0))
    out = fed(sequencer, messages)
    assert sequencer.newest_ns == 10**18 + round(0.005 * 399 * 1e9)
    assert [s for _, s in out if s < 1000] == pytest.approx([0.005 * i for i in range(len(out))])
    assert len(sequencer.flush(ahead=False)) + len(out) == 400
    assert len(sequencer.flush()) == 1


def test_after_a_pause_all_streams_go_on_an_hour_later():
    sequencer: Sequencer = Sequencer(INPUTS)
    messages = [("sensor/attitude", "a", 0.005 * i) for i in range(100)]
    messages += [("sensor/attitude", "a", 3600 + 0.005 * i) for i in range(100)]
    out = fed(sequencer, messages) + sequencer.flush()
    assert len(out) == 200 and [s for _, s in out] == sorted(s for _, s in out)
    assert sequencer.newest_ns == 10**18 + round((3600 + 0.005 * 99) * 1e9)


def test_a_stream_with_a_clock_of_its_own_is_left_out_and_named():
    problems: list = []
    sequencer: Sequencer = Sequencer(INPUTS, problem=lambda kind, text: problems.append((kind, text)))
    messages = []
    for i in range(400):
        messages.append(("sensor/attitude", "a", 0.005 * i))
        if i % 40 == 20:
            messages.append(("sensor/gnss", "receiver", 604_800.0 + 0.005 * i))
    out = fed(sequencer, messages) + sequencer.flush()
    assert len(problems) == 10 and {topic for topic, _ in out} == {"sensor/attitude"}
    kind, text = problems[-1]
    assert kind == "clock" and "sensor/gnss of 'receiver' is stamped 604800" in text


@pytest.mark.parametrize("topics", [("sensor/gnss",), ("sensor/lines/B", "sensor/lines/F", "sensor/lines/N")])
def test_a_clock_that_jumps_ahead_in_flight_does_not_take_the_time_of_the_platform_along(topics):
    """The check of the stream hands on the first two of them together, which is no confirmation of one another."""
    problems: list = []
    check: StreamCheck = StreamCheck()
    sequencer: Sequencer = Sequencer([*INPUTS, *topics], problem=lambda kind, text: problems.append((kind, text)))
    out, number = [], dict.fromkeys(["sensor/attitude", *topics], 0)
    for i in range(2000):
        seconds = 0.005 * i
        spoken = [("sensor/attitude", "a", seconds)]
        if i % 40 == 20:
            spoken += [(topic, "other", seconds + (3600.0 if seconds > 5 else 0.0)) for topic in topics]
        for topic, source, stamped in spoken:
            envelope = Envelope(10**18 + round(stamped * 1e9), source, number[topic])
            number[topic] += 1
            for passed in check.accept(topic, envelope, (topic, envelope)):
                late = sequencer.push(*passed, (topic, stamped), seconds)
                out += [] if late is None else [late]
        out += sequencer.pop(seconds)
    assert sequencer.newest_ns == 10**18 + round(0.005 * 1999 * 1e9)
    assert len(problems) == len(topics) * 25
    assert all(kind == "clock" and "'other' is stamped 3600" in text for kind, text in problems)
    out += sequencer.flush()
    assert max(seconds for _, seconds in out) < 10 and len(out) == 2000 + 25 * len(topics)
