"""Paths of the grippers: limits, smoothness, what holds when, and that they go where they are told."""

import math

import pytest
import torch

from torchcloth.boundaries.motion import check, check_cover, interpolate
from torchcloth.errors import InvalidInput
from torchcloth.robots.primitives import Limits, cover, drag, fling, minimum_jerk
from torchcloth.robots.primitives.moves import PERIOD

TABLE = {"left": (-0.2, 0.3, 0.01), "right": (0.2, 0.3, 0.01)}
HANGING = {"left": (-0.2, 0.0, 0.6), "right": (0.2, 0.0, 0.6)}
LIMITS = Limits(0.8, 4.0)
ACTIONS = {
    "cover": lambda **k: cover(TABLE, 0.5, limits=LIMITS, **k),
    "low cover": lambda **k: cover(TABLE, 0.5, height=0.05, limits=LIMITS, **k),
    "fling": lambda **k: fling(HANGING, limits=LIMITS, **k),
    "drag": lambda **k: drag(TABLE, limits=LIMITS, **k),
}


@pytest.fixture(params=ACTIONS)
def action(request):
    return ACTIONS[request.param]()


def fine(action, name="left"):
    """(step, positions [N, 3]) of what the layer makes of the knots."""
    times = torch.linspace(0, action.duration, 20001, dtype=torch.float64)
    return float(times[1]), interpolate(action.motion[name], times)[:, :3, 3]


def test_the_layer_accepts_it(action):
    for name, trajectory in action.motion.items():
        check(trajectory, name)
        check_cover(trajectory, name, 0.0, action.duration)
    assert float(action.motion["left"].t.diff().max()) <= max(PERIOD, 0.5 * (action.duration - action.release)) + 1e-9


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
    assert float(v[0].norm()) < 1e-2
    assert float(v[-1].norm()) < 1e-9


def test_closed_until_release(action):
    t, _, closed = action.motion["right"]
    assert torch.equal(closed, t < action.release - 1e-9)
    assert bool(closed[0])
    assert not bool(closed[-1])
    assert 0 < action.release < action.duration


def test_grippers_stay_apart_and_above_the_table(action):
    left, right = (action.motion[name].pose[:, :3, 3] for name in ("left", "right"))
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
    for limits in (Limits(0.5, 100.0), Limits(100.0, 2.0)):
        a = drag({"left": (0.0, 0.0, 0.05)}, 0.4, heading=0.3, height=0.05, landing=0.05, limits=limits)
        truth = max(15 / 8 * 0.4 / limits.speed, math.sqrt(10 / math.sqrt(3) * 0.4 / limits.acceleration))
        assert a.release == pytest.approx(truth, rel=1e-4)
        end = a.motion["left"].pose[-1, :3, 3]
        torch.testing.assert_close(end, torch.tensor([0.4 * math.cos(0.3), 0.4 * math.sin(0.3), 0.05]))


def test_fling_goes_back_before_it_goes_forward():
    y = fling(HANGING, 0.25, heading=math.pi / 2, pull=0.1, landing=0.04).motion["left"].pose[:, 1, 3]
    assert float(y.min()) == pytest.approx(-0.25, abs=1e-9)
    assert float(y.max()) == pytest.approx(0.25, abs=1e-9)
    assert int(y.argmin()) < int(y.argmax())
    assert float(y[-1]) == pytest.approx(0.15)


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
        (lambda: drag(TABLE, 0.3, limits=Limits(0.0, 1.0)), "speed"),
        (lambda: drag({}, 0.3), "grips"),
        (lambda: drag({"left": (0.0, float("nan"), 0.1)}, 0.3), "grips"),
        (lambda: drag({"left": (0.0, 0.1)}, 0.3), "grips"),
        (lambda: drag({"left": (0.0, 0.1, -0.1)}, 0.3), "path"),
        (lambda: drag({"left": (0.0, 0.0, 0.2), "right": (0.1, 0.0, 0.1)}, 0.3, height=-0.05), "height"),
        (lambda: fling(TABLE, landing=0.1), "height over the landing"),
    ],
)
def test_refusals(make, what):
    with pytest.raises(InvalidInput, match=what):
        make()
