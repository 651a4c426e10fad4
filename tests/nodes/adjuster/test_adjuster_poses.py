"""Which of the poses between measured ones are to be relied on."""

from __future__ import annotations

import numpy as np
import pytest

from triline.nodes.adjuster.poses import PoseBuffer
from triline.nodes.convert import PlainPose
from triline.solver.geometry.measured_trajectory import MeasuredTrajectory


def sample(valid):
    return PlainPose(0, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0], (np.eye(6) * 1e-6).ravel().tolist(), valid)


@pytest.fixture
def buffer():
    """Poses at 5 Hz from 10 to 20 s, invalid up to 12 s."""
    buffer = PoseBuffer()
    for i in range(51):
        time = 10.0 + 0.2 * i
        buffer.add(time, sample(time > 12.01), False, "aligning" if time <= 12.01 else "")
    return buffer


def test_between_invalid_poses_nothing_is_valid(buffer):
    grid = np.arange(10.0, 20.0, 0.05)
    valid = np.array([buffer.validity(t)[0] for t in grid])
    assert (valid == (grid >= 12.2 - 1e-9)).all()
    assert buffer.validity(11.1) == (False, "aligning")
    assert buffer.validity(12.1) == (False, "aligning")  # one neighbour is enough


def test_a_pose_at_the_time_itself_stands_alone(buffer):
    assert buffer.validity(12.0) == (False, "aligning")
    assert buffer.validity(12.2) == (True, "")


def test_smoothed_poses_count_where_there_are_any(buffer):
    for i in range(11):
        buffer.add(10.0 + 0.2 * i, sample(True), True, "")
    assert buffer.validity(11.1) == (True, "")
    assert buffer.validity(12.1) == (False, "aligning")


def test_late_and_old_poses(buffer):
    buffer.add(15.1, sample(False), False, "late")
    assert buffer.validity(15.05) == (False, "late")
    for i in range(5000):
        buffer.add(20.2 + 0.2 * i, sample(True), False, "")
    assert len(buffer._seen[False][0]) < 3000
    assert buffer.validity(1000.0) == (True, "")


def test_what_was_invalid_long_ago_is_still_known(buffer):
    for i in range(5000):
        buffer.add(20.2 + 0.2 * i, sample(True), False, "")
    assert buffer.validity(11.1) == (False, "aligning") and buffer.validity(12.1) == (False, "aligning")
    assert buffer.validity(15.0) == (True, "")


def test_known_again_is_a_new_filter_once():
    buffer = PoseBuffer(known_only=True)
    unknown = PlainPose(0, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0], np.eye(6).ravel().tolist(), False)
    buffer.add(9.0, unknown, False, "aligning")
    buffer.add(10.0, sample(True), False, "")
    assert not buffer.started_anew()  # the first one is none
    buffer.add(11.0, unknown, False, "aligning")
    assert not buffer.started_anew()
    buffer.add(12.0, sample(True), False, "")
    assert buffer.started_anew() and not buffer.started_anew()


def test_between_the_smoothings_of_two_filters_the_filtered_poses_count():
    measured = MeasuredTrajectory()
    q, P = np.array([0.0, 0.0, 0.0, 1.0]), np.eye(6)
    for smoothed, times in ((False, np.arange(0.0, 30.0, 0.1)), (True, np.r_[0.0:10.0:0.1, 20.0:25.0:0.1])):
        position = np.column_stack([70.0 * times, np.full_like(times, 5.0 * smoothed), 0.0 * times])
        measured.add(times, position, np.tile(q, (len(times), 1)), np.tile(P, (len(times), 1, 1)), smoothed)
    at = measured.at([5.05, 15.05, 22.05])
    assert at.smoothed.tolist() == [True, False, True] and at.poses.position_l[1, 1] == pytest.approx(0.0, abs=1e-9)
