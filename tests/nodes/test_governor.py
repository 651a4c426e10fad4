"""Load control against nodes of known cost on a clock that is counted, not read."""

from __future__ import annotations

import numpy as np
import pytest

from triline.nodes.adjuster.pace import LEVELS, LOSSLESS
from triline.nodes.adjuster.pace import PARTS as OF_ADJUSTER
from triline.nodes.governor import Governor
from triline.nodes.matcher.pace import PARTS, SHARES

BLOCK_S, WINDOW_S = 0.1, 12.0


class Node:
    """A node that gets a block every tenth of a second, and works ``cost(flown, parts)`` s a second of the flight.

    Attributes
    ----------
    level, lag_s : at every block
    """

    def __init__(self, cost, seconds=120.0, parts=PARTS, lossless=0, rate=1.0, stall=(0.0, 0.0), seed=0):
        governor, rng = Governor(parts, lossless), np.random.default_rng(seed)
        self.governor = governor
        now = busy = 0.0
        looked = -1.0
        level, lag = [], []
        for k in range(round(seconds / BLOCK_S)):
            flown, arrives = k * BLOCK_S, k * BLOCK_S / rate
            now = max(now, arrives)
            if stall[0] <= now < sum(stall):
                now = sum(stall)
            lag.append(now - arrives)
            work = BLOCK_S * cost(flown, parts[governor.level]) * rng.lognormal(0, 0.2)
            now, busy = now + work, busy + work
            if now > looked + 0.1:
                looked = now
                governor.look(lag[-1], now, busy, flown, WINDOW_S)
            level.append(governor.level)
        self.level, self.lag_s = np.array(level), np.array(lag)

    def share(self, begin_s, end_s):
        """Mean share of the places that are tried in a part of the flight."""
        return np.mean([SHARES[k] for k in self.level[round(begin_s / BLOCK_S) : round(end_s / BLOCK_S)]])


def _of(fixed, saved):
    return lambda flown, parts: fixed * parts[0] + saved * parts[1]


def test_where_there_is_time_nothing_is_shed_whatever_heap_there_is():
    """A hiccup of three seconds: the heap goes away by itself; one that hurts is helped for seconds only."""
    node = Node(_of(0.2, 0.3), stall=(30.0, 3.0))
    assert not node.level.any() and node.lag_s.max() > 2.9 and node.lag_s[-1] < 0.1
    node = Node(_of(0.2, 0.5), stall=(30.0, 6.0))
    assert node.share(30, 45) > 0.7 and not node.level[round(45 / BLOCK_S) :].any()


@pytest.mark.parametrize(("saved", "share"), [(2.0, 0.35), (1.3, 0.5), (4.6, 0.1)])
def test_what_is_shed_is_what_the_machine_cannot_do(saved, share):
    """With 0.2 s of work in any case the rest leaves room for so much, and that is what is done, without a swing."""
    node = Node(_of(0.2, saved))
    assert node.share(30, 120) == pytest.approx(share, rel=0.25)
    assert len(np.flatnonzero(np.diff(node.level[300:]))) <= 4
    assert node.lag_s.max() < 3.5 and node.lag_s[300:].max() < 2.5
    assert max(node.level) < len(PARTS) - 1, "never blind while there is time for lines"


def test_full_work_comes_back_as_fast_as_it_went():
    def cost(flown, parts):
        return 0.2 * parts[0] + (1.5 if 30 < flown < 60 else 0.3) * parts[1]

    node = Node(cost)
    assert node.share(40, 60) == pytest.approx(0.5, rel=0.25)
    assert node.share(0, 30) == 1.0 and node.share(70, 120) == 1.0


def test_a_burst_of_work_is_no_reason_to_shed_most_of_it():
    """Six seconds of twice the work that can be done: some of it is shed, and all comes back."""
    node = Node(lambda flown, parts: 0.15 * parts[0] + (1.4 if 30 < flown < 36 else 0.45) * parts[1])
    assert node.share(30, 45) > 0.75 and min(SHARES[k] for k in node.level) >= 0.5
    assert node.lag_s.max() < 1.5 and not node.level[500:].any()


def test_a_heap_that_leaves_together_is_not_taken_for_a_flight_that_comes_faster():
    """What was held back for its order for two seconds comes at once, and waits for the work on it only."""
    governor, flown, now, busy = Governor(PARTS), 100.0, 0.0, 0.0
    for _ in range(60):
        flown, now, busy = flown + 0.1, now + 0.1, busy + 0.05
        assert not governor.look(0.0, now, busy, flown, WINDOW_S)
    now += 2.0
    for k in range(20):  # all of it within a second, and the last one waited for it
        flown, now, busy = flown + 0.1, now + 0.05, busy + 0.05
        assert not governor.look(0.05 * (k + 1) + 0.2, now, busy, flown, WINDOW_S)


def test_a_load_just_below_what_can_be_done_is_left_alone():
    assert not Node(_of(0.2, 0.77)).level.any()


def test_blind_only_where_lines_alone_are_too_much_and_tried_again_then():
    node = Node(_of(1.5, 2.0))
    blind = node.level == len(PARTS) - 1
    assert 0.5 < blind[100:].mean() < 0.95 and node.lag_s.max() < 0.6 * WINDOW_S
    eased = Node(lambda flown, parts: (1.5 if flown < 40 else 0.3) * parts[0] + 0.3 * parts[1])
    assert (eased.level[:400] == len(PARTS) - 1).any() and not eased.level[800:].any()


@pytest.mark.parametrize("rate", [0.5, 4.0])
def test_a_replay_at_another_speed(rate):
    """Four times as fast a node of 0.1 s a second has time enough, one of 0.5 s has not."""
    assert not Node(_of(0.1 / rate, 0.5 / rate), rate=rate).level.any()
    assert 0.2 < Node(_of(0.2 / rate, 2.0 / rate), rate=rate).share(60, 120) < 0.5


def test_larger_batches_come_first_and_lose_nothing():
    """An adjuster whose updates are too many: before a heap hurts it takes larger batches, and leaves no point out."""
    node = Node(_of(0.9, 0.3), parts=OF_ADJUSTER, lossless=LOSSLESS)
    assert 1 <= node.level.max() <= LOSSLESS and node.lag_s.max() < 2.0
    many = Node(_of(0.5, 2.0), parts=OF_ADJUSTER, lossless=LOSSLESS)
    assert [LEVELS[k][1] for k in (min(many.level[300:]), max(many.level[300:]))] == pytest.approx(
        [0.25, 0.25], abs=0.26
    )


def test_nothing_is_decided_before_anything_is_known():
    governor = Governor(PARTS)
    assert not governor.look(11.0, 1.0, 0.1, 100.0, WINDOW_S) and governor.level == 0
