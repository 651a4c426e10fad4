"""Messages of a group are like those that are made one by one."""

import gc

import pytest
from google.protobuf.message import DecodeError

from triline.schemas import codec, groups
from triline.schemas import messages as m
from triline.schemas.groups import Grouped, grouped


def test_a_message_of_a_group_is_like_any_other():
    fields = {"point": "p", "x": 1.5, "covariance": [1.0] * 9, "residuals": [{"v_line": 0.25}]}
    one, other = m.ObjectPoint(**fields), grouped(m.ObjectPoint)(**fields)
    assert other == one
    assert type(other) is m.ObjectPoint
    assert codec.encode(other) == codec.encode(one)
    assert codec.parse("point/object", codec.encode(one)) == one


@pytest.mark.parametrize("count", [1, groups.TOGETHER, groups.TOGETHER + 1, 5 * groups.TOGETHER])
def test_messages_of_a_group_know_nothing_of_each_other(count):
    new = Grouped(m.TiePoint)
    ties = [new(point=f"p{i}") for i in range(count)]
    for i, tie in enumerate(ties):
        tie.images.add(strip=f"S{i}")
    assert [(tie.point, [look.strip for look in tie.images]) for tie in ties] == [
        (f"p{i}", [f"S{i}"]) for i in range(count)
    ]


def test_a_message_outlives_its_group():
    new = Grouped(m.TiePoint)
    kept = new(point="kept", images=[{"strip": "S1", "line": 2.0}]).images[0]
    for i in range(10 * groups.TOGETHER):
        new(point=f"p{i}")
    gc.collect()
    assert (kept.strip, kept.line) == ("S1", 2.0)


def test_a_payload_that_is_none_leaves_the_others_as_they_are():
    new = Grouped(m.TiePoint)
    before = new.from_bytes(m.TiePoint(point="before").SerializeToString())
    with pytest.raises(DecodeError):
        new.from_bytes(m.TiePoint(point="broken", images=[{"strip": "S"}]).SerializeToString()[:-1])
    after = new.from_bytes(m.TiePoint(point="after").SerializeToString())
    assert (before.point, after.point, len(after.images)) == ("before", "after", 0)


def test_a_long_payload_is_read_like_a_short_one():
    body = m.TiePoint(point="p" * (2 * groups.LONG))
    assert Grouped(m.TiePoint).from_bytes(body.SerializeToString()) == body
    assert codec.parse("observation/tie", memoryview(codec.encode(body))) == body
