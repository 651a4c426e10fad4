"""Strips that are imaged at the same time, as by two cameras or several lenses: a report tells each of them apart."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic_flight import flight_messages

from triline.nodes.node import Message
from triline.nodes.report.evaluation import evaluate_flight, intersect_points, orientation_errors
from triline.nodes.report.figures import correction_functions, errors, trajectory_map
from triline.nodes.report.flight import collect
from triline.nodes.report.integrity import levels, protection_figure
from triline.nodes.report.strip_time import StripTime
from triline.nodes.report.style import styled

ORIENTATION = ("orientation/live", "orientation/final")
SHIFT_M = 1.0


def copied(message, **fields):
    body = type(message.body)()
    body.CopyFrom(message.body)
    for name, value in fields.items():
        setattr(body, name, value)
    return Message(message.topic, message.stamp_ns, body, message.source, message.sequence)


@pytest.fixture(scope="module")
def alone():
    messages = flight_messages(seconds=34.0, points=150)
    for message in messages:
        if message.topic == "adjustment/report":
            message.body.sigma[:], message.body.protection[:] = [0.1] * 6, [0.4] * 6
    return messages


@pytest.fixture(scope="module")
def flights(alone):
    """A flight with one strip, and one with another strip beside it, of a camera that is 1 m further in X."""
    both = []
    for number, message in enumerate(alone):
        if message.topic == "configuration/strip":
            both += [message, copied(message, id="S2")]
        elif message.topic in ORIENTATION:
            second = copied(message, strip="S2")
            second.body.pose.position.x += SHIFT_M
            second.body.correction[0] += SHIFT_M
            both += [second, message] if number % 2 else [message, second]
        elif message.topic in ("observation/tie", "point/object") and int(message.body.point[1:]) % 2:
            second = copied(message)
            for look in second.body.images if message.topic == "observation/tie" else second.body.residuals:
                look.strip = "S2"
            both.append(second)
        else:
            both.append(message)
    return collect(alone), collect(both)


def parts(line):
    """The y values of a curve, by stretches between pauses."""
    y = np.asarray(line.get_ydata(), dtype=float)
    ends = np.flatnonzero(np.isnan(y))
    return [part[np.isfinite(part)] for part in np.split(y, ends)]


@pytest.mark.parametrize("draw", [correction_functions, errors])
@pytest.mark.parametrize("name", ["live", "final"])
def test_curves_of_each_stand_under_their_strip(flights, draw, name):
    """All of them stood under the second one, and were those of the strip that came last."""
    one, two = flights
    with styled():
        ax, of_one = draw(two).axes[0], draw(one).axes[0]
    (line,) = (line for line in ax.lines if line.get_label() == name)
    (whole,) = (line for line in of_one.lines if line.get_label() == name)
    first, second = parts(line)
    np.testing.assert_allclose(first, np.asarray(whole.get_ydata())[: len(first)])
    np.testing.assert_allclose(second, first + SHIFT_M)
    assert len(first) >= 600
    assert [text.get_text() for text in ax.texts] == ["S1", "S2"]


def test_what_is_of_no_strip_stands_under_both(flights):
    one, two = flights
    with styled():
        (line,) = (line for line in errors(two).axes[0].lines if line.get_label() == "filtered")
        (alone,) = (line for line in errors(one).axes[0].lines if line.get_label() == "filtered")
        first, second = parts(line)
        np.testing.assert_allclose(first, np.asarray(alone.get_ydata())[::2])  # as many samples on an axis as before
        np.testing.assert_allclose(second, first)
        level = next(line for line in protection_figure(two).axes[0].lines if line.get_label() == "protection level")
    assert len(parts(level)) == 2 and len(parts(level)[0]) == len(parts(level)[1]) > 20
    t = np.arange(0.0, 34.0, 0.5)
    x, y = StripTime(two).curve(t, t)
    assert (np.diff(x[np.isfinite(x)]) > 0).all() and np.isnan(x).sum() == 1
    known = y[np.isfinite(y)]
    np.testing.assert_array_equal(known[: len(known) // 2], known[len(known) // 2 :])


def test_figures_are_of_the_orientation_of_both(flights):
    one, two = flights
    alone, both = (evaluate_flight(flight)["orientation"]["final"] for flight in flights)
    assert both["n"] == 2 * alone["n"]
    assert both["mean_m"][0] == pytest.approx(alone["mean_m"][0] + SHIFT_M / 2)
    found = orientation_errors(two)["final"]
    assert (np.diff(found.time_ns) >= 0).all() and set(found.strip) == {"S1", "S2"}
    np.testing.assert_array_equal(levels(two)[3], levels(one)[3])  # the reports are of S1


def test_points_are_intersected_with_the_orientation_of_the_strip_that_sees_them(flights):
    one, two = (intersect_points(flight)["final"] for flight in flights)
    assert one[0] == two[0]
    beside = np.array([int(id[1:]) % 2 == 1 for id in one[0]])
    moved = (two[1] - one[1])[:, 0]
    assert beside.any() and not beside.all()
    np.testing.assert_allclose(moved, np.where(beside, SHIFT_M, 0.0), atol=0.02)


def test_strips_that_begin_at_one_place_are_named_together_on_the_map(flights):
    with styled():
        assert "S1, S2" in [text.get_text() for text in trajectory_map(flights[1]).axes[0].texts]
