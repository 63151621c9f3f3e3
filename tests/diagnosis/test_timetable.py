"""Share and time left of a diagnosis, from measured diagnoses of small episodes."""

import re

import pytest

from torchcloth.cli import diagnose as command
from torchcloth.diagnosis.timetable import Timetable

EPISODE_S = 0.76  # of the measured diagnoses

# s, and line: a diagnosis of one motion, measured on two cores
ONE_MOTION = (
    (0.7, "from the data sheet: fast, 1 of 1"),
    (2.4, "from the data sheet: fast, 1 of 1"),
    (3.1, "base model: fit 1: fast, 1 of 1"),
    (4.0, "base model: fit 2: fast, 1 of 1"),
    (4.8, "base model: fit 3: fast, 1 of 1"),
    (5.5, "base model: 38 causes: fast, 1 of 1"),
    (7.3, "bifurcating bins: fast, 1 of 1"),
    (8.5, "missing force: fast"),
    (9.5, "next experiment: hang, 1 of 12"),
    (9.6, "next experiment: hang, grippers and cloth turned by 90 degrees, 2 of 12"),
    (11.3, "next experiment: swing, 0.7 times as fast, 3 of 12"),
    (11.3, "next experiment: swing, 4 of 12"),
    (13.4, "next experiment: swing, 1.5 times as fast, 5 of 12"),
    (13.6, "next experiment: swing, grippers and cloth turned by 90 degrees, 6 of 12"),
    (15.3, "next experiment: swing-fast, 7 of 12"),
    (15.8, "next experiment: swing-fast, grippers and cloth turned by 90 degrees, 8 of 12"),
    (16.7, "next experiment: shake, 9 of 12"),
    (17.1, "next experiment: stretch, 10 of 12"),
    (18.7, "next experiment: turn, 11 of 12"),
    (19.0, "next experiment: turn, grippers and cloth turned by 90 degrees, 12 of 12"),
)
ONE_MOTION_END_S = 21.3

# the same of three motions, without most lines of the second and third episode
THREE_MOTIONS = (
    (1.3, "from the data sheet: fast, 1 of 3"),
    (3.7, "from the data sheet: slow, 2 of 3, 5 s left"),
    (3.8, "from the data sheet: lift, 3 of 3, 1 s left"),
    (4.6, "from the data sheet: fast, 1 of 3"),
    (6.7, "base model: fit 1: fast, 1 of 3"),
    (8.4, "base model: fit 2: fast, 1 of 3"),
    (9.9, "base model: fit 3: fast, 1 of 3"),
    (11.6, "base model: fit 4: fast, 1 of 3"),
    (13.2, "base model: fit 5: fast, 1 of 3"),
    (14.7, "base model: as fitted: fast, 1 of 3"),
    (16.0, "base model: 38 causes: fast, 1 of 3"),
    (18.7, "bifurcating bins: fast, 1 of 3"),
    (20.7, "trying air.drag_n: as fitted: fast, 1 of 3"),
    (23.0, "trying air.linear: as fitted: fast, 1 of 3"),
    (24.7, "trying air.added_mass: as fitted: fast, 1 of 3"),
    (26.6, "trying damp.bend: as fitted: fast, 1 of 3"),
    (29.1, "trying air.drag_n further: fit 2: fast, 1 of 3"),
    (31.3, "trying air.drag_n further: fit 3: fast, 1 of 3"),
    (33.7, "trying air.drag_n further: as fitted: fast, 1 of 3"),
    (36.3, "trying air.linear further: fit 2: fast, 1 of 3"),
    (38.6, "trying air.linear further: fit 3: fast, 1 of 3"),
    (40.5, "trying air.linear further: as fitted: fast, 1 of 3"),
    (43.8, "with air.drag_n: fit 2: fast, 1 of 3"),
)
THREE_MOTIONS_END_S = 58.9


def replay(lines, count, several, speed=1.0):
    """Return [(s since the start, reported text, s left)] of a diagnosis whose lines come at these times."""
    now, reported = [0.0], []
    timetable = Timetable([EPISODE_S] * count, several, lambda: now[0])
    progress, rows = timetable.wrap(reported.append), []
    for t, text in lines:
        now[0] = t * speed
        progress(text)
        rows.append((now[0], reported[-1], timetable.time_left()))
    return rows


@pytest.mark.parametrize("speed", [1.0, 100.0])
@pytest.mark.parametrize(
    ("lines", "count", "end"), [(ONE_MOTION, 1, ONE_MOTION_END_S), (THREE_MOTIONS, 3, THREE_MOTIONS_END_S)]
)
def test_the_time_left_is_right_within_a_factor_of_two(monkeypatch, lines, count, end, speed):
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    rows = replay(lines, count, count > 1, speed)
    assert rows[0][2] is None  # nothing has been measured
    first_part = [(t, left) for t, _, left in rows[1:] if t < 0.6 * speed * end]
    assert all(0.5 < left / (speed * end - t) < 2.0 for t, left in first_part)
    shares = [int(re.findall(r"(\d+) % done", text)[0]) for _, text, _ in rows[1:]]
    assert 0 < shares[0] < 15 < 50 < shares[-1] < 100


def test_a_line_ends_with_share_and_time_left_of_all_and_not_of_its_pass():
    text = replay(THREE_MOTIONS, 3, True)[2][1]
    assert re.fullmatch(r"from the data sheet: lift, 3 of 3; \d+ % done, about \d+ s left", text)


def test_what_was_stored_by_a_stopped_diagnosis_does_not_shorten_the_rest():
    """The first passes of a resumed diagnosis take no time."""
    count = next(k for k, (_, text) in enumerate(THREE_MOTIONS) if text.startswith("trying"))
    begin = THREE_MOTIONS[count][0]
    rows = replay([(max(t - begin, 1e-3 * k), text) for k, (t, text) in enumerate(THREE_MOTIONS)], 3, True)
    assert rows[count][2] < 1.0
    assert 0.5 < rows[-1][2] / (THREE_MOTIONS_END_S - begin - rows[-1][0]) < 3.0


def test_a_stage_that_nobody_expected_is_added():
    force_laws = (THREE_MOTIONS_END_S, "force laws: 10 causes: fast, 1 of 3")
    without = replay((*THREE_MOTIONS, (THREE_MOTIONS_END_S, "next experiment: hang")), 3, True)
    assert replay((*THREE_MOTIONS, force_laws), 3, True)[-1][2] > without[-1][2] + 5.0


def test_a_log_has_one_line_for_each_pass(monkeypatch):
    monkeypatch.setattr("sys.stderr.isatty", lambda: False)
    printed = []
    monkeypatch.setattr(command, "print_line", printed.append)
    with command.show_progress_line() as progress:
        for text in ("a: fast, 1 of 12; 3 % done", "a: slow, 2 of 12; 4 % done", "next experiment: hang; 9 % done"):
            progress(text)
    assert printed == ["a: fast, 1 of 12; 3 % done", "next experiment: hang; 9 % done"]
