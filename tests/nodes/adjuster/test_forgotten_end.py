"""Strips whose end nobody tells: a program that images has crashed, and begins with another strip."""

from dataclasses import replace

import pytest

from triline.nodes import convert
from triline.nodes.adjuster.adjuster import Adjuster
from triline.nodes.navigator.navigator import Navigator
from triline.nodes.simulator.flight_settings import simulated_flight
from triline.nodes.simulator.simulator import Simulator

EPOCH_NS = 1_700_000_000_000_000_000
SETTINGS = {
    "seconds": 12.0, "strips": 2, "lead_in": 2.0, "attitude_rate": 50.0, "ties": 4.0, "control": 4, "check": 6,
    "seed": 3, "sidelap": 0.4, "no_turns": True,
}  # fmt: skip


@pytest.fixture(scope="module")
def messages():
    """What the adjuster gets of two strips with nothing between them."""
    navigator, out = Navigator(filtered_s=0.2, smooth_every_s=2.0), []
    for message in Simulator(simulated_flight(SETTINGS).simulation).messages(EPOCH_NS):
        if message.topic in Navigator.inputs:
            out += [o for o in navigator.step(message) if o.topic in Adjuster.inputs]
        if message.topic in Adjuster.inputs:
            out.append(message)
    return out + [o for o in navigator.finish() if o.topic in Adjuster.inputs]


def run(messages, **settings):
    """Outputs, each with when it came (s), and counters."""
    node, out = Adjuster(grid_hz=2.0, pace="normal", update_s=1.0, update_rays=1000, **settings), []
    for message in messages:
        out += [((message.stamp_ns - EPOCH_NS) * 1e-9, o) for o in node.step(message)]
    return out + [(float("inf"), o) for o in node.finish()], node.counters


def ends(message, strip):
    return message.topic == "configuration/strip" and message.body.ended and message.body.id == strip


def whole(outputs):
    """When the poses of each strip were whole for the first time."""
    first = {}
    for at_s, o in outputs:
        if o.topic == "orientation/whole":
            first.setdefault((o.body.strip, convert.time_ns(o.body.timestamp)), at_s)
    return first


def test_a_strip_whose_end_nobody_tells_is_over_when_another_one_has_begun(messages):
    """Nothing was whole until the end of the flight, and no later strip learnt from an earlier one."""
    begun_s = next((x.stamp_ns - EPOCH_NS) * 1e-9 for x in messages if x.topic.endswith("strip") and x.body.id == "S2")
    expected, _ = run(messages)
    end = next(x for x in messages if ends(x, "S1"))
    rest = [x for x in messages if x is not end]
    for given in (rest, sorted([*rest, late(end, begun_s)], key=lambda x: x.stamp_ns)):
        outputs, counters = run(given)
        found = whole(outputs)
        assert found.keys() == whole(expected).keys()
        assert all(begun_s < at_s < begun_s + 5.0 for (strip, _), at_s in found.items() if strip == "S1")
        assert max(at_s for (strip, _), at_s in found.items() if strip == "S2") < float("inf")
        told = [o.body.message for _, o in outputs if o.topic == "event/log"]
        (line,) = (text for text in told if "nobody has told its end" in text)
        assert line.startswith("strip S1: another one has begun") and counters["strip end not told"] == 1
        assert [text for text in told if "S2 over" in text] == [
            o.body.message for _, o in expected if o.topic == "event/log" and "S2 over" in o.body.message
        ]


def test_an_image_point_in_a_line_that_is_years_ahead_holds_no_strip_open(messages):
    """One message was enough: the strip whose end nobody told went on until the end of the flight."""
    given = [open_ended(x) for x in messages if not ends(x, "S1")]
    at = next(k for k, x in enumerate(given) if x.topic == "observation/tie" and len(x.body.images) == 2)
    rate = next(x.body.line_rate_hz for x in given if x.topic == "configuration/strip")
    body = type(given[at].body)()
    body.CopyFrom(given[at].body)
    body.point = "far"
    body.images.add().CopyFrom(body.images[0])
    for image, time_ns in zip(body.images, (0, EPOCH_NS + int(1e19 / rate), given[at].stamp_ns), strict=True):
        image.line, image.time_ns = 1e10, time_ns
    given.insert(at + 1, replace(given[at], body=body))
    outputs, counters = run(given)
    told = [o.body.message for _, o in outputs if o.topic == "event/log"]
    assert [text[:9] for text in told if "another one has begun, and nobody has told its end" in text] == ["strip S1:"]
    assert counters["not imaged yet"] == 2 and counters["time is not that of its line"] == 1
    (line,) = (text for text in told if "left out, as are others" in text)
    assert line.startswith("strip S1: an image point of far in line 1e+10")
    rejected = [r for _, o in outputs if o.topic == "adjustment/report" for r in o.body.rejected]
    assert sum(r.point == "far" for r in rejected) == 3


def open_ended(message):
    """A strip that begins without saying how many lines it will have."""
    if message.topic != "configuration/strip" or message.body.ended:
        return message
    body = type(message.body)()
    body.CopyFrom(message.body)
    body.lines = 0
    return replace(message, body=body)


def late(message, begun_s):
    """The end of the strip, told when the next one has long begun."""
    return replace(message, stamp_ns=EPOCH_NS + int((begun_s + 8.0) * 1e9))


def test_strips_that_begin_together_go_on_without_image_points(messages):
    """Two cameras that image at once: one of them flies over a lake for a minute."""
    other = next(x for x in messages if x.topic.endswith("strip") and x.body.id == "S1" and not x.body.ended)
    body = type(other.body)()
    body.CopyFrom(other.body)
    body.id, body.first_line_time_ns = "B1", other.body.first_line_time_ns + 3_000_000_000
    beside = type(other)(other.topic, other.stamp_ns + 1, body, other.source, other.sequence, other.start)
    upto = next(k for k, x in enumerate(messages) if x.topic.endswith("strip") and x.body.id == "S2")
    given = [x for x in messages[:upto] if not ends(x, "S1")]
    given.insert(given.index(other) + 1, beside)
    planned = type(other.body)()  # and the next strip is announced long before it begins
    planned.CopyFrom(body)
    planned.id, planned.first_line_time_ns = "S9", body.first_line_time_ns + 300_000_000_000
    ahead = type(other)(other.topic, other.stamp_ns + 2, planned, other.source, other.sequence, other.start)
    given.insert(given.index(beside) + 1, ahead)
    outputs, counters = run(given, apriori="project")  # by the poses a strip waits for them
    assert not counters["strip end not told"] and not any("nobody has told" in str(o.body) for _, o in outputs)
