"""Plans, judged from outside: finite differences of the joints, the forward map, and the layer's own interpolation."""

import math
import shutil
import sys

import numpy as np
import pytest
import torch

import torchcloth.robots.collision_checks as crowd
from torchcloth import recordings, robots
from torchcloth.boundaries.motion import interpolate_poses
from torchcloth.errors import InvalidInput
from torchcloth.robots import GraspOrientation, plan
from torchcloth.robots import primitives as P
from torchcloth.robots.arm import Primitive
from torchcloth.robots.description import locate_urdf
from torchcloth.robots.inverse import bound_reach
from torchcloth.robots.primitives.base import PATH_KNOT_PERIOD_S
from torchcloth.robots.spline import ClampedSpline
from torchcloth.types import Trajectory


def grips(x, z, width=0.32):
    return {"left": (x, width / 2, z), "right": (x, -width / 2, z)}


TABLE, HIGH = grips(0.38, 0.015), grips(0.5, 0.6, 0.4)
# The orientations that the search finds: with them a plan takes a fraction of its time.
CASES = {
    "cover": (
        P.cover(TABLE, 0.37, heading=0.0, landing=0.04, roll=0.0),
        (0.6, -0.5, True, 0.7),
        (0.6, 0.5, False, 0.7),
    ),
    "rolled": (P.cover(TABLE, 0.37, heading=0.0, landing=0.04, roll=0.7), (0.9, 0, True, 0.7), (0.6, -0.5, True, -0.7)),
    "fold": (P.fold(TABLE, 0.18, heading=0.0, roll=0.7, landing=0.04), (0.9, 0, True, 0.7), (0.6, -0.5, True, -0.7)),
    "fling": (P.fling(grips(0.5, 0.6), 0.2, heading=0.0), (0.9, 0.5, True, -0.7), (0.9, 0, True, 0.7)),
    "drag": (P.drag(grips(0.52, 0.015), 0.2, heading=math.pi), (0.9, 0, False, -0.7), (0.9, 0, False, 0)),
    "hang": (P.hang(grips(0.5, 0.015), 0.6), (0.9, 0, True, 0.7), (0.9, 0, False, 0.7)),
    "swing": (P.swing(HIGH), (1.2, 0.5, True, 0), (1.2, -1, False, -0.7)),
    "shake": (P.shake(HIGH), (1.2, -1, False, -0.7), (1.2, -1, False, 0.7)),
    "stretch": (P.stretch(HIGH), (0.6, -0.5, True, -0.7), (0.6, 0.5, False, -0.7)),
}
MESH = '<collision><geometry><mesh filename="forearm.stl"/></geometry></collision>'
SLOWED = [name for name in CASES if name != "stretch"]


@pytest.fixture(scope="module")
def rig():
    return robots.bimanual_rig()


@pytest.fixture(scope="module")
def made(rig):
    """Every family once."""
    torch.set_num_threads(1)
    return {
        name: (
            action,
            plan(rig, action, orientations={"left": GraspOrientation(*left), "right": GraspOrientation(*right)}),
        )
        for name, (action, left, right) in CASES.items()
    }


def finely(result, name, count=8000):
    """(step, joints [N, J]) of the curve through the recorded knots, on a fine grid."""
    times = torch.linspace(0, float(result.t[-1]), count, dtype=torch.float64)
    return times, ClampedSpline(result.t, result.q[name]).positions(times)


def test_an_arm_whose_base_is_learned_is_planned(rig, made):
    base = rig["left"].base.clone().requires_grad_()
    arms = {"left": robots.load(rig["left"].model, frame=rig["left"].frame, base=base), "right": rig["right"]}
    action, left, right = CASES["hang"]
    result = plan(
        robots.Scene(arms, rig.table),
        action,
        orientations={"left": GraspOrientation(*left), "right": GraspOrientation(*right)},
    )
    torch.testing.assert_close(result.q["left"], made["hang"][1].q["left"], rtol=0, atol=1e-4)


def test_paths_in_single_precision_are_planned(rig, made):
    """torch's own default."""
    action, left, right = CASES["hang"]
    short = {name: Trajectory(p.t.float(), p.pose.float(), p.closed) for name, p in action.motion.items()}
    result = plan(
        rig,
        action._replace(motion=short),
        orientations={"left": GraspOrientation(*left), "right": GraspOrientation(*right)},
    )
    torch.testing.assert_close(result.q["left"], made["hang"][1].q["left"], rtol=0, atol=1e-4)


def test_an_arm_of_meshes_only_is_not_called_clear(rig, tmp_path):
    """Nothing would be known of what it meets."""
    path = tmp_path / "meshes.urdf"
    text = locate_urdf("rizon4").read_text()
    start = text.index("<visual>", text.index('<link name="link3"'))
    end = text.index("</link>", start)
    path.write_text(text[:start] + MESH + text[end:])
    arm = robots.load(path, frame=rig["left"].frame)
    assert arm.links_without_primitives == ("link3",)
    action, _, right = CASES["hang"]
    with pytest.raises(InvalidInput, match=r"solids of 'left'; got only meshes at link3"):
        plan(
            robots.Scene({"left": arm, "right": rig["right"]}, rig.table),
            action,
            orientations={"right": GraspOrientation(*right)},
        )


def test_single_precision_arms_are_planned_in_double(made):
    action, left, right = CASES["hang"]
    holds = {"left": GraspOrientation(*left), "right": GraspOrientation(*right)}
    rig = robots.bimanual_rig(dtype=torch.float32)
    result = plan(rig, action, orientations=holds)
    assert next(rig.buffers()).dtype == torch.float32
    for name, q in made["hang"][1].q.items():
        torch.testing.assert_close(result.q[name], q, rtol=0, atol=1e-5)


@pytest.mark.parametrize("family", CASES)
@pytest.mark.parametrize("arm", ["left", "right"])
def test_within_position_velocity_and_acceleration_limits(rig, made, family, arm):
    _, result = made[family]
    times, q = finely(result, arm)
    limits, step = rig[arm].limits, float(times[1])
    assert bool((q >= limits.soft_lower - 1e-3).all() & (q <= limits.soft_upper + 1e-3).all())
    velocity = q.diff(dim=0) / step
    assert bool((velocity.abs() <= limits.velocity).all())
    acceleration = velocity.diff(dim=0) / step
    assert float(acceleration.abs().max()) <= robots.DEFAULT_JOINT_ACCELERATION * 1.01
    assert float(velocity[[0, -1]].abs().max()) < 2 * robots.DEFAULT_JOINT_ACCELERATION * step  # from rest to rest


def test_which_are_slowed_down(made):
    assert {family for family, (_, result) in made.items() if result.slowdown > 1} == set(SLOWED)


@pytest.mark.parametrize("family", SLOWED)
def test_some_limit_is_used_when_slowed_down(rig, made, family):
    _, result = made[family]
    worst = 0.0
    for name in result.q:
        times, q = finely(result, name)
        velocity = q.diff(dim=0) / float(times[1])
        acceleration = velocity.diff(dim=0) / float(times[1])
        share = float((velocity.abs() / rig[name].limits.velocity).max())
        worst = max(worst, share, float(acceleration.abs().max()) / robots.DEFAULT_JOINT_ACCELERATION)
    assert worst > 0.98


@pytest.mark.parametrize("family", CASES)
@pytest.mark.parametrize("arm", ["left", "right"])
def test_the_joints_lead_along_the_path_between_knots_too(rig, made, family, arm):
    """Against what the layer makes of the asked-for path, and what it makes of the recorded knots."""
    action, result = made[family]
    times = torch.linspace(0, action.duration, 4001, dtype=torch.float64)
    asked = interpolate_poses(action.motion[arm], times)
    still = (
        action.motion[arm].t[(action.motion[arm].pose != action.motion[arm].pose[-1]).any(-1).any(-1)][-1]
        + PATH_KNOT_PERIOD_S
    )
    asked[times >= still] = action.motion[arm].pose[-1]  # the layer would creep by 0.1 mm between knots 0.2 s apart
    through_joints = rig[arm](ClampedSpline(result.t, result.q[arm]).positions(result.slowdown * times))
    assert float((through_joints - asked)[:, :3, 3].norm(dim=-1).max()) < 1e-4
    replayed = interpolate_poses(result.motion(rig)[arm], (result.slowdown * times).clamp(max=float(result.t[-1])))
    assert float((replayed - asked)[:, :3, 3].norm(dim=-1).max()) < 1e-4
    turn = through_joints[:, :3, :3] @ through_joints[0, :3, :3].mT @ asked[:, :3, :3].mT
    assert float((turn - torch.eye(3)).abs().max()) < 1e-3


@pytest.mark.parametrize("family", CASES)
def test_solids_keep_their_distance(rig, made, family):
    """Points of one arm's solids are outside the other's and above the table: no formula shared with the planner."""
    _, result = made[family]
    solids = {name: rig[name].geometry(value[::10]) for name, value in result.q.items()}
    for name, custom in solids.items():
        lowest = [float(_points(p)[..., 2].min()) for p in custom[4:]]
        assert min(lowest) > -1e-3, name
        assert min(lowest[:-1]) > 0.02 - 1e-3, name
    for one, other in (("left", "right"), ("right", "left")):
        points = torch.cat([_points(p) for p in solids[one]], 1)
        assert min(float(_outside(p, points).min()) for p in solids[other]) > 0.02 - 1e-3


def test_points_know_solids_that_cross():
    """What the test above relies on: two bars that cross in their middles have no corner near each other."""

    def bar(*size):
        return Primitive("box", size, torch.eye(4, dtype=torch.float64).expand(1, 4, 4), "bar")

    one, other = bar(0.4, 0.02, 0.02), bar(0.02, 0.4, 0.02)
    assert float(_outside(other, _points(one)).min()) < 0
    post = other._replace(kind="cylinder", size=(0.01, 0.4))
    assert float(_outside(post, _points(one)).min()) < 0
    assert float(_outside(one, _points(post)).min()) < 0


def _points(p, apart=0.01):
    """[T, N, 3] on the surface of a box or cylinder, about ``apart`` m from each other."""

    def line(length):
        return torch.linspace(-0.5, 0.5, 2 + int(length / apart), dtype=torch.float64) * length

    if p.kind == "box":
        x, y, z = map(line, p.size)
        local = torch.cartesian_prod(x, y, z)
        half = torch.tensor(p.size, dtype=torch.float64) / 2
        local = local[((local.abs() - half).abs() < 1e-9).any(1)]
    else:
        radius, length = p.size
        angle = torch.linspace(0, 2 * math.pi, 2 + int(2 * math.pi * radius / apart), dtype=torch.float64)[:-1]
        circle = torch.stack([angle.cos(), angle.sin()], -1)

        def at(r, z):
            return torch.cat([r * circle, torch.full((len(angle), 1), float(z))], -1)

        ends = [at(r, z) for r in torch.arange(0, radius, apart) for z in (-length / 2, length / 2)]
        local = torch.cat([*ends, *(at(radius, z) for z in line(length))])
    return (p.pose[:, None, :3, :3] @ local[None, :, :, None])[..., 0] + p.pose[:, None, :3, 3]


def _outside(p, points):
    """Signed distance [T, N] m of points [T, N, 3] from a box or cylinder."""
    local = ((points - p.pose[:, None, :3, 3])[..., None, :] @ p.pose[:, None, :3, :3])[..., 0, :]
    if p.kind == "box":
        beyond = local.abs() - torch.tensor(p.size, dtype=torch.float64) / 2
    else:
        beyond = torch.stack([local[..., :2].norm(dim=-1) - p.size[0], local[..., 2].abs() - p.size[1] / 2], -1)
    return beyond.clamp(min=0).norm(dim=-1) + beyond.amax(-1).clamp(max=0)


def test_no_instant_is_farther_from_the_next_than_is_said(rig, made, monkeypatch):
    """A path whose knots are farther apart is looked at between them."""
    looked = []

    def within(scene, name, q, times, clearance):
        looked.append(float(times.diff().max()))
        return crowd.check_self_and_table(scene, name, q, times, clearance)

    monkeypatch.setattr(sys.modules["torchcloth.robots.plan"], "check_self_and_table", within)
    action, left, right = CASES["hang"]
    coarse = {}
    for name, path in action.motion.items():
        knots = torch.linspace(0, len(path.t) - 1, 90).round().long().unique()
        coarse[name] = Trajectory(path.t[knots], path.pose[knots], path.closed[knots])
    assert float(coarse["left"].t.diff().max()) > 0.03
    plan(
        rig,
        action._replace(motion=coarse),
        orientations={"left": GraspOrientation(*left), "right": GraspOrientation(*right)},
    )
    assert looked
    assert max(looked) <= 0.02 + 1e-9


def test_orientations_of_nobody_and_no_motion_are_refused(rig, made):
    action, left, _ = CASES["hang"]
    with pytest.raises(InvalidInput, match=r"orientations of unknown arms; got \['Left'\]; expected among"):
        plan(rig, action, orientations={"Left": GraspOrientation(*left)})
    with pytest.raises(InvalidInput, match="action; got no motion"):
        plan(rig, action._replace(motion={}))


@pytest.mark.parametrize("family", ["fling", "hang"])
def test_grippers_open_when_they_should(made, family):
    action, result = made[family]
    closed = result.closed["left"]
    if family == "hang":
        assert bool(closed.all())
    else:
        assert result.release_time == pytest.approx(result.slowdown * action.release_time)
        assert torch.equal(closed, result.t < result.release_time - 1e-9)


def test_a_recording_of_it_replays_to_the_same_poses(rig, made, tmp_path):
    _, result = made["fling"]
    recording = recordings.Recording(
        cloth=recordings.ClothInfo(areal_density=0.2, sheet=(0.4, 0.4)),
        provenance="synthetic: test",
        joints=result.joint_motions(),
        robots=rig.robot_infos(),
    )
    again = robots.replay(recordings.read(recordings.write(recording, tmp_path / "episode")))
    for name, trajectory in result.motion(rig).items():
        assert torch.equal(again[name].t, trajectory.t)
        assert float((again[name].pose - trajectory.pose).abs().max()) < 1e-12
        assert torch.equal(again[name].closed, trajectory.closed)


def test_a_urdf_file_beside_the_episode_is_found(tmp_path, monkeypatch):
    infos = {"left": recordings.RobotInfo("arm.urdf", np.eye(4), "flange")}
    q = np.zeros((2, 7))
    recording = recordings.Recording(
        cloth=recordings.ClothInfo(areal_density=0.2, sheet=(0.4, 0.4)),
        provenance="synthetic: test",
        joints={"left": recordings.JointMotion(np.array([0.0, 1.0]), q, closed=np.ones(2, bool))},
        robots=infos,
    )
    episode = recordings.write(recording, tmp_path / "episode")
    shutil.copy(locate_urdf("rizon4"), episode / "arm.urdf")
    monkeypatch.chdir(tmp_path)
    pose = robots.replay(recordings.read(episode))["left"].pose[0]
    assert float((pose - robots.load("rizon4")(pose.new_zeros(7))).abs().max()) < 1e-12


def test_the_search_finds_a_way_and_prefers_a_fast_one(rig):
    action = P.stretch(HIGH, 0.03, hold=0.2, rest=0.1)
    result = plan(rig, action, acceleration=1.0)
    clumsy = plan(
        rig,
        action,
        acceleration=1.0,
        orientations={"left": GraspOrientation(0.3, 1.0), "right": GraspOrientation(0.3, -1.0)},
    )
    assert 1 < result.slowdown < clumsy.slowdown


def test_a_lone_arm_moves_while_the_other_stands(rig):
    action = P.hang({"left": (0.5, 0.3, 0.1)}, 0.3, rest=0.2)
    result = plan(rig, action, orientations={"left": GraspOrientation(0.2)})
    assert float(result.q["right"].diff(dim=0).abs().max()) == 0
    assert not bool(result.closed["right"].any())
    assert float(result.motion(rig)["left"].pose[-1, 2, 3]) == pytest.approx(0.3, abs=1e-6)


@pytest.mark.parametrize(
    ("action", "options", "what"),
    [
        (
            P.swing(HIGH),
            {"slow_down": False},
            r"acceleration limit of 'joint\d' of '(left|right)' at t = .* rad/s\^2.*slow_down",
        ),
        (P.hang(grips(0.5, 0.2), 1.1), {}, r"pose \d+ cannot be reached by 'rizon4'.* at t = "),
        (P.hang(grips(1.6, 0.2), 0.5), {}, r"the path of 'left' leaves the reach .* from the shoulder"),
        (P.hang(grips(0.5, 0.10, 0.02), 0.3), {}, r"\w+ of left comes too near to \w+ of right at t = .*roll"),
        (
            P.hang(grips(0.5, 0.012), 0.3),
            {"orientations": {"left": GraspOrientation(1.5)}},
            r"\w+ of left comes too near to the table.*they touch or cross",
        ),
        (P.hang({"middle": (0.5, 0.0, 0.1)}, 0.3), {}, "action moves unknown arms"),
        (P.swing(HIGH), {"acceleration": float("nan")}, "acceleration"),
    ],
)
def test_refusals_name_what_is_in_the_way(rig, action, options, what):
    holding = {"orientations": {"left": GraspOrientation(0.6), "right": GraspOrientation(0.6)}} | options
    with pytest.raises(InvalidInput, match=what):
        plan(rig, action, **holding)


def test_no_posture_is_beyond_the_reach_and_a_stretched_arm_nearly_meets_it(rig, random_q):
    arm = rig["left"]
    shoulder, longest = bound_reach(arm, arm.home)
    away = (arm(random_q(arm, 5000))[:, :3, 3] - shoulder).norm(dim=-1)
    assert 0.8 * longest < float(away.max()) < longest


def test_a_plan_is_told_in_a_line(made):
    _, result = made["hang"]
    assert len(repr(result)) < 200
    assert result.limiting_joint in repr(result)
    assert f"{result.slowdown:.3g} times" in repr(result)


def test_paths_with_too_few_knots_are_refused(rig):
    pose = torch.eye(4, dtype=torch.float64).repeat(4, 1, 1)
    pose[:, :3, 3] = torch.tensor([0.5, 0.3, 0.3], dtype=torch.float64)
    pose[1, 0, 3], pose[2, 2, 3] = 0.7, 0.6
    t = torch.tensor([0.0, 0.5, 1.0, 1.5], dtype=torch.float64)
    action = P.Action({"left": Trajectory(t, pose, torch.ones(4, dtype=torch.bool))}, 1.5, 1.5)
    with pytest.raises(InvalidInput, match=r"stray from the path .*more knots"):
        plan(rig, action, orientations={"left": GraspOrientation()})


def test_a_plan_is_plain_numpy_for_a_recording(made):
    for joints in made["swing"][1].joint_motions().values():
        assert isinstance(joints.q, np.ndarray)
        assert joints.closed.dtype == bool


@pytest.mark.parametrize("order", [("left", "right"), ("right", "left")])
def test_each_gripper_opens_by_its_own_path(order):
    """One arm stands still: its path needs fewer points than the other's."""
    rig, t = robots.bimanual_rig(), torch.arange(61, dtype=torch.float64) * 0.03
    moving = P.minimum_jerk((t / 1.2).clamp(max=1))

    def path(y, rise, closed):
        pose = torch.eye(4, dtype=torch.float64).repeat(len(t), 1, 1)
        pose[:, 0, 3], pose[:, 1, 3], pose[:, 2, 3] = 0.5, y, 0.3 + rise * moving
        return Trajectory(t, pose, closed)

    custom = {"left": path(0.2, 0.0, t >= 0), "right": path(-0.2, 0.1, t < 1.5 - 1e-9)}
    holds = {"left": GraspOrientation(0.9, 0, True, 0.7), "right": GraspOrientation(0.9, 0, False, 0.7)}
    result = plan(rig, P.Action({name: custom[name] for name in order}, float(t[-1]), 1.5), orientations=holds)
    opened = result.t[~result.closed["right"]]
    assert float(opened[0]) == pytest.approx(1.5 * result.slowdown, abs=0.02)
    assert bool(result.closed["left"].all())


def test_paths_that_do_not_end_together_are_refused():
    t = torch.tensor([0.0, 1.0], dtype=torch.float64)
    still = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    closed = torch.ones(2, dtype=torch.bool)
    motion = {"left": Trajectory(t, still, closed), "right": Trajectory(1.5 * t, still, closed)}
    with pytest.raises(InvalidInput, match="one end"):
        plan(robots.bimanual_rig(), P.Action(motion, 1.5, 1.0))


def test_an_idle_arm_in_the_table_is_refused():
    arms = robots.bimanual_rig()
    scene = robots.Scene({name: arms[name] for name in ("left", "right")}, robots.Table(height=0.25))
    with pytest.raises(InvalidInput, match=r"the idle arm: .* of right comes too near to the table.*leave that"):
        plan(scene, P.hang({"left": (0.55, 0.3, 0.40)}, height=0.5, rest=0.2))
