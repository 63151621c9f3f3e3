"""Paths of the grippers: limits, smoothness, what holds when, and that they go where they are told."""

import math

import pytest
import torch

from torchcloth.boundaries.motion import check_covers_times, check_trajectory, interpolate_poses
from torchcloth.errors import InvalidInput
from torchcloth.robots.primitives import (
    GripperLimits,
    cover,
    drag,
    fling,
    fold,
    hang,
    minimum_jerk,
    shake,
    stretch,
    swing,
)
from torchcloth.robots.primitives.base import PATH_KNOT_PERIOD_S

TABLE = {"left": (-0.2, 0.3, 0.01), "right": (0.2, 0.3, 0.01)}
HANGING = {"left": (-0.2, 0.0, 0.6), "right": (0.2, 0.0, 0.6)}
LIMITS = GripperLimits(0.8, 4.0)
ACTIONS = {
    "cover": lambda **k: cover(TABLE, 0.5, limits=LIMITS, **k),
    "low cover": lambda **k: cover(TABLE, 0.5, height=0.05, limits=LIMITS, **k),
    "fling": lambda **k: fling(HANGING, limits=LIMITS, **k),
    "drag": lambda **k: drag(TABLE, limits=LIMITS, **k),
    "fold": lambda **k: fold(TABLE, limits=LIMITS, **k),
    "hang": lambda **k: hang(TABLE, carry=0.1, limits=LIMITS, **k),
    "swing": lambda **k: swing(HANGING, period=0.1, limits=LIMITS, **k),
    "shake": lambda **k: shake(HANGING, period=0.01, limits=LIMITS, **k),
    "stretch": lambda **k: stretch(HANGING, 0.1, hold=0.01, limits=LIMITS, **k),
}
HELD = ("hang", "swing", "shake", "stretch")  # to the end


@pytest.fixture(params=ACTIONS)
def action(request):
    return ACTIONS[request.param]()


# Knots of the paths as they were before they moved here: number, duration, release, and of the right gripper's knot at
# 45 % its time, place and upward axis.
BEFORE = [
    (
        lambda: cover(TABLE, 0.37, height=0.05, heading=0.3, roll=1.0),
        (58, 1.4901524542669753, 1.0901524542669752),
        (0.51534479656257, 0.3485219912065826, 0.34594323574439767, 0.06356049647644607),
        (0.41464786286482364, 0.1282656148072499, 0.9008968208844743),
    ),
    (
        lambda: fling(HANGING, 0.15, heading=1.2, pull=0.1),
        (109, 2.489812701485, 2.089812701485),
        (0.9655052229125969, 0.25406291804583503, 0.13905802234847672, 0.6),
        (0.0, 0.0, 1.0),
    ),
    (
        lambda: drag(TABLE, 0.2, heading=-0.4),
        (49, 1.181595079445781, 0.8815950794457811),
        (0.42636034542290757, 0.2715803167494935, 0.2697363274831845, 0.05),
        (0.0, 0.0, 1.0),
    ),
]


@pytest.mark.parametrize(("make", "whole", "knot", "up"), BEFORE, ids=["cover", "fling", "drag"])
def test_the_ablation_gets_the_paths_it_always_had(make, whole, knot, up):
    """Equal bit by bit on one machine; sines differ between machines in the last bit or two."""
    a = make()
    t, pose, _ = a.motion["right"]
    i = int(0.45 * len(t))
    assert (len(t), a.duration, a.release_time) == pytest.approx(whole, rel=1e-13)
    assert [float(t[i]), *pose[i, :3, 3].tolist()] == pytest.approx(knot, rel=1e-13, abs=1e-16)
    assert pose[i, :3, 2].tolist() == pytest.approx(up, rel=1e-13, abs=1e-16)


def fine(action, name="left"):
    """(step, positions [N, 3]) of what the layer makes of the knots."""
    times = torch.linspace(0, action.duration, 20001, dtype=torch.float64)
    return float(times[1]), interpolate_poses(action.motion[name], times)[:, :3, 3]


def test_the_layer_accepts_it(action):
    for name, trajectory in action.motion.items():
        check_trajectory(trajectory, name)
        check_covers_times(trajectory, name, 0.0, action.duration)
    assert (
        float(action.motion["left"].t[:-2].diff().max()) <= PATH_KNOT_PERIOD_S + 1e-9
    )  # the last two intervals are the rest


def test_speed_stays_within_the_limit_and_reaches_a_limit(action):
    """The slower of both limits is met within 2 %: paths waste no time."""
    step, x = fine(action)
    speed = x.diff(dim=0).norm(dim=-1).max() / step
    knots = action.motion["left"]
    rise = knots.pose[:, :3, 3].diff(dim=0) / knots.t.diff()[:, None]
    acceleration = (rise.diff(dim=0) / knots.t.diff()[1:, None]).norm(dim=-1).max()
    assert speed <= LIMITS.speed * 1.01
    assert acceleration <= LIMITS.acceleration * 1.02
    assert max(speed / LIMITS.speed, acceleration / LIMITS.acceleration) > 0.95


def test_no_jump_of_speed(action):
    """Between neighbouring instants speed changes by the acceleration alone; it starts and ends at rest."""
    step, x = fine(action)
    v = x.diff(dim=0) / step
    assert float(v.diff(dim=0).norm(dim=-1).max()) < 2 * LIMITS.acceleration * step
    assert float(v[0].norm()) < 2e-2  # the layer starts with the slope of the first interval
    assert float(v[-1].norm()) < 1e-9


@pytest.mark.parametrize("name", ACTIONS)
def test_closed_until_release(name):
    made = ACTIONS[name]()
    t, _, closed = made.motion["right"]
    if name in HELD:
        assert made.release_time == made.duration
        assert bool(closed.all())
        return
    assert torch.equal(closed, t < made.release_time - 1e-9)
    assert bool(closed[0])
    assert not bool(closed[-1])
    assert 0 < made.release_time < made.duration


@pytest.mark.parametrize("name", [name for name in ACTIONS if name != "stretch"])
def test_grippers_stay_apart_and_above_the_table(name):
    made = ACTIONS[name]()
    left, right = (made.motion[hand].pose[:, :3, 3] for hand in ("left", "right"))
    torch.testing.assert_close(right - left, (right - left)[:1].expand_as(left))
    assert float(left[:, 2].min()) >= 0


def test_cover_turns_the_grip_over_and_lands():
    a = cover(TABLE, 0.5, heading=-math.pi / 2, landing=0.03)
    pose = a.motion["left"].pose
    torch.testing.assert_close(pose[-1, :3, 3], torch.tensor([-0.2, -0.2, 0.03]))
    torch.testing.assert_close(pose[-1, :3, 2], torch.tensor([0.0, 0.0, -1.0]), atol=1e-12, rtol=0)
    upright = pose[int((pose[:, 2, 2]).abs().argmin()), :3, 2]
    assert float(upright[1]) < -0.99, "half way the upper side looks where the grippers go"
    top = float(pose[:, 2, 3].max())
    assert top == pytest.approx(0.02 + 0.25, abs=5e-3)  # half the reach above the middle of grip and landing


def test_drag_takes_the_least_time_of_a_minimum_jerk_move():
    """Closed form: T = max(15/8 L / v, sqrt(10/sqrt(3) L / a)), here with lift and landing of no height."""
    for limits in (GripperLimits(0.5, 100.0), GripperLimits(100.0, 2.0)):
        a = drag({"left": (0.0, 0.0, 0.05)}, 0.4, heading=0.3, height=0.05, landing=0.05, limits=limits)
        truth = max(15 / 8 * 0.4 / limits.speed, math.sqrt(10 / math.sqrt(3) * 0.4 / limits.acceleration))
        assert a.release_time == pytest.approx(truth, rel=1e-4)
        end = a.motion["left"].pose[-1, :3, 3]
        torch.testing.assert_close(end, torch.tensor([0.4 * math.cos(0.3), 0.4 * math.sin(0.3), 0.05]))


def test_fling_goes_back_before_it_goes_forward():
    y = fling(HANGING, 0.25, heading=math.pi / 2, pull=0.1, landing=0.04).motion["left"].pose[:, 1, 3]
    assert float(y.min()) == pytest.approx(-0.25, abs=1e-9)
    assert float(y.max()) == pytest.approx(0.25, abs=1e-9)
    assert int(y.argmin()) < int(y.argmax())
    assert float(y[-1]) == pytest.approx(0.15)


def test_fold_lands_behind_the_crease():
    a = fold(TABLE, 0.2, heading=-math.pi / 2, height=0.15, landing=0.03, short=0.02)
    pose = a.motion["right"].pose
    torch.testing.assert_close(pose[-1, :3, 3], torch.tensor([0.2, 0.3 - 2 * 0.2 + 0.02, 0.03]))
    torch.testing.assert_close(pose[-1, :3, 2], torch.tensor([0.0, 0.0, -1.0]), atol=1e-12, rtol=0)
    assert float(pose[:, 2, 3].max()) == pytest.approx(0.15)
    crossing = (pose[:, 1, 3] < 0.29) & (pose[:, 1, 3] > -0.07)
    assert float(pose[crossing, 2, 3].min()) == pytest.approx(0.15), "level while it crosses"


def test_hang_lifts_and_carries():
    last = hang(TABLE, 0.4, carry=-0.1, heading=math.pi / 2).motion["left"].pose[-1, :3, 3]
    torch.testing.assert_close(last, torch.tensor([-0.2, 0.2, 0.4]))


def test_stretch_is_symmetric_and_comes_back():
    a = stretch(HANGING, 0.06, cycles=2, hold=0.5)
    left, right = (a.motion[hand].pose[:, :3, 3] for hand in ("left", "right"))
    torch.testing.assert_close(left + right, (left + right)[:1].expand_as(left))
    distance = (left - right).norm(dim=-1)
    assert float(distance.max()) == pytest.approx(0.46, abs=1e-6)
    assert float(distance[-1]) == pytest.approx(0.4)
    assert a.duration == pytest.approx(4 * 0.5 + 0.3)


@pytest.mark.parametrize(("make", "axis"), [(swing, 0), (shake, 2)])
def test_to_and_fro(make, axis):
    a = make(HANGING, 0.05, cycles=3, period=1.2)
    x = a.motion["left"].pose[:, axis, 3] - HANGING["left"][axis]
    assert (float(x.min()), float(x.max())) == pytest.approx((-0.05, 0.05))
    assert abs(float(x[-1])) < 1e-12
    signs = x[x.abs() > 0.01].sign()
    assert int((signs.diff() != 0).sum()) == 2 * 3 - 1
    assert float(a.motion["left"].t[-3]) == pytest.approx(3 * 1.2)  # where the rest begins


def test_minimum_jerk_is_at_rest_at_both_ends():
    u = torch.linspace(0, 1, 1001)
    s = minimum_jerk(u)
    assert (float(s[0]), float(s[-1])) == (0.0, 1.0)
    assert bool((s.diff() > 0).all())
    second = s.diff(n=2) / (u[1] - u[0]) ** 2
    assert float(second[[0, -1]].abs().max()) < 0.1
    assert float(second.abs().max()) == pytest.approx(10 / math.sqrt(3), rel=1e-3)


@pytest.mark.parametrize(
    ("make", "what"),
    [
        (lambda: cover(TABLE, 0.0), "reach"),
        (lambda: cover(TABLE, 0.5, height=-0.1), "height"),
        (lambda: cover(TABLE, 0.5, rest=float("nan")), "rest"),
        (lambda: drag(TABLE, 0.3, heading=float("inf")), "heading"),
        (lambda: drag(TABLE, 0.3, limits=GripperLimits(0.0, 1.0)), "speed"),
        (
            lambda: drag(TABLE, 0.3, limits=GripperLimits(1e-9, 1.0)),
            r"speed or acceleration; got 1e-09 m/s .*; expected at most",
        ),
        (lambda: drag(TABLE, 0.3, limits=GripperLimits(1.0, 1e-12)), r"speed or acceleration"),
        (lambda: drag({}, 0.3), "grips"),
        (lambda: drag({"left": (0.0, float("nan"), 0.1)}, 0.3), "grips"),
        (lambda: drag({"left": (0.0, 0.1)}, 0.3), "grips"),
        (lambda: drag({"left": 0.5}, 0.3), "grips"),
        (lambda: drag({"left": ("near", 0.0, 0.1)}, 0.3), "grips"),
        (lambda: drag({"left": (0.0, 0.1, -0.1)}, 0.3), "path"),
        (lambda: drag({"left": (0.0, 0.0, 0.2), "right": (0.1, 0.0, 0.1)}, 0.3, height=-0.05), "height"),
        (lambda: fling(TABLE, landing=0.1), "height over the landing"),
        (lambda: fold(TABLE, 0.01), "reach"),
        (lambda: fold(TABLE, height=0.02), "height over the landing"),
        (lambda: fold(HANGING, height=0.3), "height above the table; got 0.3 m; .*the lowest is at 0.6 m"),
        (lambda: hang(HANGING, 0.5), "height above the table; got 0.5 m; .*the lowest is at 0.6 m"),
        (lambda: hang(TABLE, float("nan")), "height above the table"),
        (lambda: fold((0.5, 0.2, 0.02)), r"grips; got \(0.5, 0.2, 0.02\); expected .*\"left\""),
        (lambda: hang(TABLE, 0.5, carry=float("nan")), "carry"),
        (lambda: swing(HANGING, 0.0), "amplitude"),
        (lambda: swing(HANGING, cycles=0), "cycles"),
        (lambda: swing(HANGING, cycles=0.5), "cycles"),
        (lambda: stretch(HANGING, 0.06, cycles=1.5), "cycles"),
        (lambda: cover(HANGING, 0.2, roll=math.nan), "roll"),
        (lambda: shake(TABLE, 0.05), "below z = 0"),
        (lambda: shake(TABLE, elevation=float("inf")), "elevation"),
        (lambda: stretch({"left": (0.0, 0.0, 0.1)}), "two"),
        (lambda: stretch({"left": (0.0, 0.0, 0.1), "right": (0.0, 0.0, 0.1)}), "one place"),
    ],
)
def test_refusals(make, what):
    with pytest.raises(InvalidInput, match=what):
        make()
