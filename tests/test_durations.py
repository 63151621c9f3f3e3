"""Times in words, and the time that a search takes at most."""

import pytest

from torchcloth._utils.durations import IterationTimer, describe_time


@pytest.mark.parametrize(
    ("seconds", "said"), [(2.0, "about 5 s"), (43.0, "about 45 s"), (95.0, "about 2 min"), (9000.0, "about 2.5 h")]
)
def test_a_time_is_said_as_roughly_as_it_is_known(seconds, said):
    assert describe_time(seconds) == said


def test_the_time_of_a_search_is_bounded_by_its_iterations():
    now = [0.0]
    timer = IterationTimer(20, lambda: now[0])
    assert timer.describe(0, 0.5) == ""  # nothing has been measured
    now[0] = 10.0
    assert timer.describe(1, 0.5) == "at most about 7 min left"  # 20 iterations of 20 s on all frames
    for k in range(2, 12):
        now[0] += 30.0
        said = timer.describe(k)
    assert said == "at most about 5 min left"  # 10 of 30 s
    now[0] += 300.0
    assert timer.describe(11) == said  # the same iteration again


def test_a_search_that_took_all_its_iterations_has_nothing_left():
    now = [0.0]
    timer = IterationTimer(1, lambda: now[0])
    for k in range(4):
        now[0] += 60.0
        said = timer.describe(k)
    assert said == "at most about 5 s left"
