"""What was estimated of a vibration, and of which time it tells."""

import numpy as np

from triline.solver.window.state.vibrations import Vibrations


def test_a_time_has_the_largest_that_was_estimated_from_it_on():
    vibrations, times = Vibrations(), np.array([0.0, 10.0, 10.1, 20.0, 30.0, 99.0])
    assert (vibrations.since(times) == 0.0).all()
    for now_s, known in ((5.0, 0.0), (10.0, 3.0), (20.0, 2.0), (25.0, 1.0), (30.0, 2.0), (40.0, 1.0)):
        vibrations.note(now_s, known, possible=None)
    assert vibrations.since(times).tolist() == [3.0, 3.0, 2.0, 2.0, 2.0, 1.0]


def test_what_may_have_been_counts_until_it_is_certain_that_it_was_not():
    vibrations, times = Vibrations(), np.array([0.0, 10.0, 11.0])
    vibrations.note(5.0, 0.0, possible=4.0)
    vibrations.note(10.0, 0.0, possible=7.0)
    vibrations.note(15.0, 0.0, possible=0.0)
    assert vibrations.since(times).tolist() == [7.0, 7.0, 0.0]
    vibrations.note(20.0, 2.0, possible=None)
    assert vibrations.since(times).tolist() == [2.0, 2.0, 2.0]
