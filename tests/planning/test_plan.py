"""Plans: the cloth ends at the goal, what is expected happens, and what is in the way stays apart."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.planning_scenes import DURATION_S, build_nominal_cloth, describe_cloth, make_arm_episode, make_hand_episode

import torchcloth as tc
from torchcloth import recordings as rec
from torchcloth.diagnosis import World, WorldModel, build_base_model
from torchcloth.diagnosis.causes.hypotheses import list_known_hypotheses
from torchcloth.episodes.replay import Replay
from torchcloth.episodes.streams import locate_on_pattern
from torchcloth.errors import InvalidInput
from torchcloth.identification import build_cloth, build_episode
from torchcloth.planning import Goal
from torchcloth.planning.episode_conversion import extract_motion_parameters
from torchcloth.planning.forward_model import ForwardModel, exact_model
from torchcloth.planning.task import PlanningTask
from torchcloth.robots import DEFAULT_JOINT_ACCELERATION, to_gripper_motion
from torchcloth.robots.primitives import GripperLimits

WAIT = 0.1
QUICK = {"wait": WAIT, "iterations": 6}
AWAY = torch.tensor([0.04, 0.02, 0.03])


def task_of(recording, goal, waypoints=2):
    cloth = build_nominal_cloth(recording).requires_grad_(False)
    courses = extract_motion_parameters(cloth, recording, waypoints, WAIT, DEFAULT_JOINT_ACCELERATION, GripperLimits())
    return PlanningTask([ForwardModel(exact_model(cloth), recording, courses, None)], courses, goal, None, None)


def end_of(recording, at=None):
    """([V, 3] m, faces) of the cloth at the end, with so much added."""
    task = task_of(recording, Goal(torch.zeros(1, 3)))
    at = task.start if at is None else at
    return task.evaluate_models(at)[1][-1], task.forward_models[0].faces


def shifted_goal(recording, way=AWAY):
    """Where the recorded motion's cloth would be if all were shifted, as a surface."""
    x, faces = end_of(recording)
    return Goal(x + way, faces)


@pytest.mark.parametrize("scene", [make_hand_episode, make_arm_episode])
def test_slopes_are_derivatives_through_arm_and_cloth(scene):
    recording = scene()
    task = task_of(recording, shifted_goal(recording))
    at, way = 0.02 * torch.randn(len(task.start)), torch.randn(len(task.start))
    slope, pull = task.distance_gradient(at)[1], task.quadratic_model(at)
    errors = {"distance": [], "square": []}
    for h in (1e-4, 1e-5, 1e-6, 1e-7):
        up, down = (task.evaluate(at + sign * h * way) for sign in (1, -1))
        for result, custom, k in zip(errors.values(), (slope, pull.gradient), (0, 1), strict=True):
            result.append(abs((up[k] - down[k]) / (2 * h) / float(custom @ way) - 1))
    assert min(errors["distance"]) < 1e-6
    assert min(errors["square"]) < 1e-6


def test_the_cloth_ends_at_a_goal_that_another_mesh_and_another_motion_made():
    recording, motion = make_hand_episode(), make_hand_episode()
    path = motion.grippers["hand"]
    s = (path.t / DURATION_S)[:, None]
    other = replace(path, position=path.position + (10 * s**3 - 15 * s**4 + 6 * s**5) * AWAY.numpy())
    finer = tc.meshes.rectangle(0.2, 0.2, triangles=288)
    x = np.array([0.0, 0.0, 0.5]) + np.stack([0 * finer.uv[:, 0], finer.uv[:, 0], finer.uv[:, 1] - 0.2], axis=-1)
    end, faces = end_of(replace(motion, cloth=describe_cloth(x, finer), grippers={"hand": other}))
    result = tc.plan(build_nominal_cloth(recording), recording, Goal(end, faces), **QUICK)
    assert result.distance_before[0] > 0.015
    assert result.distance_after[0] < 2e-3 < 0.15 * result.distance_before[0]
    assert result.distance_history[0] == result.distance_before[0]
    assert min(result.distance_history) == pytest.approx(result.distance_after[0])
    assert 0.03 < result.path_change["hand"] < 0.1


def test_each_piece_comes_to_where_it_shall_be():
    recording = make_hand_episode()
    x, faces = end_of(recording)
    path = recording.grippers["hand"]
    s = (path.t / DURATION_S)[:, None]
    moved = replace(path, position=path.position + (10 * s**3 - 15 * s**4 + 6 * s**5) * AWAY.numpy())
    wanted, _ = end_of(replace(recording, grippers={"hand": moved}))
    goal = Goal(wanted, faces, vertices=torch.arange(len(x)))
    result = tc.plan(build_nominal_cloth(recording), recording, goal, **QUICK)
    assert result.distance_before[0] == pytest.approx(float((x - wanted).norm(dim=1).mean()), rel=1e-6)
    assert result.distance_after[0] < 0.15 * result.distance_before[0]
    assert result.distance_after[0] == pytest.approx(float((result.frames[-1] - wanted).norm(dim=1).mean()), rel=1e-6)


def test_the_planned_episode_does_what_was_expected(tmp_path):
    recording = make_arm_episode()
    result = tc.plan(build_nominal_cloth(recording), recording, shifted_goal(recording), **QUICK)
    assert result.distance_after[0] < 0.5 * result.distance_before[0]
    folder, _ = result.save(tmp_path)
    again = rec.read(folder)
    cloth = build_cloth(again)
    seen = build_episode(cloth, again, 20.0)
    with torch.no_grad():
        x = Replay(cloth)(seen).x[-1]
    assert torch.allclose(x, result.frames[-1], atol=2e-4)  # frames at other times, substeps of other lengths


def test_a_free_motion_beyond_what_a_hand_can_do_is_not_planned():
    recording = make_hand_episode()
    goal = shifted_goal(recording, 5 * AWAY)
    slow = tc.plan(
        build_nominal_cloth(recording), recording, goal, limits=GripperLimits(speed=0.2, acceleration=2.0), **QUICK
    )
    t, path = slow.motion["hand"].t, slow.motion["hand"].pose[:, :3, 3]
    assert slow.nearest_limit[0] == pytest.approx(1.0, abs=1e-3)
    assert float((path.diff(dim=0) / t.diff()[:, None]).abs().max()) < 0.205
    fast = tc.plan(build_nominal_cloth(recording), recording, goal, **QUICK)
    assert fast.distance_after[0] < 0.5 * slow.distance_after[0]


def test_adam_descends_too():
    recording = make_hand_episode()
    result = tc.plan(
        build_nominal_cloth(recording),
        recording,
        shifted_goal(recording),
        method="adam",
        iterations=25,
        rate=0.005,
        wait=WAIT,
    )
    assert result.distance_after[0] < 0.35 * result.distance_before[0]
    assert len(result.distance_history) == 26


def test_a_robot_that_errs_is_corrected_for():
    """The arm's base is 2 cm elsewhere; what is seen is 1 cm elsewhere again."""
    recording = make_hand_episode()
    off, blind = torch.tensor([0.0, 0.02, 0.0]), torch.tensor([0.01, 0.0, 0.0])

    def driven(e):
        moved = {}
        for name, m in e.motion.items():
            pose = m.pose.clone()
            pose[:, :3, 3] += off
            moved[name] = m._replace(pose=pose)
        return replace(e, motion=moved, initial=e.initial + off)

    world = World(build_nominal_cloth(recording)).with_motion_transform(driven)
    world = world.with_observation_transform(lambda frames, e: frames._replace(x=frames.x + blind))
    x, faces = end_of(recording)
    result = tc.plan(WorldModel(world, (), torch.zeros(0)), recording, Goal(x, faces), **QUICK)
    assert result.distance_before[0] > 8e-3
    assert result.distance_after[0] < 0.15 * result.distance_before[0]
    way = result.motion["hand"].pose[-1, :3, 3] - result.motion["hand"].pose.new_tensor([0.03, 0.0, 0.5])
    assert torch.allclose(way, -(off + blind).to(way), atol=4e-3)


def test_of_several_models_the_mean_is_descended():
    recording = make_hand_episode()
    goal = shifted_goal(recording)
    light, heavy = build_nominal_cloth(recording), build_nominal_cloth(recording)
    heavy.areal_density.set(0.9)
    both = tc.plan([light, heavy], recording, goal, **QUICK)
    assert len(both.distance_before) == len(both.distance_after) == 2
    assert both.distance_history[0] == pytest.approx(sum(both.distance_before) / 2)
    assert both.distance_before[0] != both.distance_before[1]
    assert sum(both.distance_after) < 0.4 * sum(both.distance_before)


def test_a_stopped_search_goes_on_and_ends_alike(tmp_path):
    recording = make_hand_episode()
    cloth, goal = build_nominal_cloth(recording), shifted_goal(recording)
    whole = tc.plan(cloth, recording, goal, **QUICK)

    def stop(number, distance, best):
        if number == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        tc.plan(cloth, recording, goal, journal=tmp_path / "kept", on_progress=stop, **QUICK)
    with pytest.raises(InvalidInput, match="resume"):
        tc.plan(cloth, recording, goal, journal=tmp_path / "kept", **QUICK)
    with pytest.raises(InvalidInput, match="another fit"):
        tc.plan(cloth, recording, shifted_goal(recording, -AWAY), journal=tmp_path / "kept", resume=True, **QUICK)
    for view in (lambda frames, e: frames._replace(x=frames.x + 0.01), lambda f, e: f._replace(x=f.x + 0.02 * f.v)):
        elsewhere = WorldModel(
            World(cloth).with_observation_transform(view), (), torch.zeros(0)
        )  # a camera, and a late clock
        with pytest.raises(InvalidInput, match="another fit"):
            tc.plan(elsewhere, recording, goal, journal=tmp_path / "kept", resume=True, **QUICK)
    seen = []
    again = tc.plan(
        cloth,
        recording,
        goal,
        journal=tmp_path / "kept",
        resume=True,
        on_progress=lambda *numbers: seen.append(numbers),
        **QUICK,
    )
    assert again.distance_history == whole.distance_history
    assert torch.equal(again.frames, whole.frames)


def test_the_users_cloth_is_left_as_it_is():
    recording = make_hand_episode()
    cloth = build_nominal_cloth(recording)
    before = [p.requires_grad for p in cloth.parameters()]
    tc.plan(cloth, recording, shifted_goal(recording), wait=WAIT, iterations=1)
    assert [p.requires_grad for p in cloth.parameters()] == before
    assert all(p.grad is None for p in cloth.parameters())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"waypoints": 0}, "waypoints.*whole number > 0"),
        ({"iterations": 2.5}, "iterations.*whole number"),
        ({"wait": -1.0}, "wait.*0 to 60"),
        ({"rate": float("nan")}, "rate.*finite"),
        ({"method": "newton"}, "method.*one of gauss-newton, adam"),
        ({"clearance": 0.0}, "clearance.*> 0"),
    ],
)
def test_options_that_give_no_search_are_refused(options, message):
    recording = make_hand_episode()
    with pytest.raises(InvalidInput, match=message):
        tc.plan(build_nominal_cloth(recording), recording, Goal(torch.zeros(4, 3)), **options)


def test_a_goal_in_millimetres_is_refused():
    recording = make_hand_episode()
    goal = Goal(1e3 * end_of(recording)[0])
    with pytest.raises(InvalidInput, match=r"goal.*in metres"):
        tc.plan(build_nominal_cloth(recording), recording, goal)


def test_models_that_are_none_are_refused():
    recording = make_hand_episode()
    for model in ([], ["cloth"], None):
        with pytest.raises(InvalidInput, match=r"model.*a Cloth or a diagnosis.WorldModel"):
            tc.plan(model, recording, Goal(torch.zeros(4, 3)))  # type: ignore[arg-type]


def test_a_patch_that_a_diagnosis_moved_is_carried_over_once():
    """With nothing added, what is rehearsed is what the model's world shows of the episode."""
    recording = make_hand_episode()
    named = {h.name: h for h in list_known_hypotheses()}
    for name, amplitude in (("robot.regrasp", 0.012), ("obs.clock", 0.02)):
        model = build_base_model(recording).with_hypothesis(named[name], amplitude)
        courses = extract_motion_parameters(
            model.base.cloth, recording, 2, 0.0, DEFAULT_JOINT_ACCELERATION, GripperLimits()
        )
        run = ForwardModel(model, recording, courses, None)
        seen = run.simulate({c.name: c.trajectory(c.zero_waypoints) for c in courses})
        data = replace(build_episode(model.base.cloth, recording, 20.0), times=run.times)
        plain_world = model.build_world().simulate_observed(data).x
        assert torch.allclose(seen[:-1], plain_world[:-1], atol=1e-4)


def test_pieces_are_those_of_the_cloth_whatever_a_grip_really_holds():
    """A patch that a diagnosis moved stretches the world's pattern there, and nothing that is seen."""
    recording = make_hand_episode()
    named = {h.name: h for h in list_known_hypotheses()}
    models = [build_base_model(recording), build_base_model(recording).with_hypothesis(named["robot.regrasp"], 0.012)]
    uv = recording.cloth.uv[::7]
    courses = extract_motion_parameters(
        models[0].base.cloth, recording, 2, 0.0, DEFAULT_JOINT_ACCELERATION, GripperLimits()
    )
    for model in models:
        run = ForwardModel(model, recording, courses, None)
        x = run.simulate({c.name: c.trajectory(c.zero_waypoints) for c in courses})[-1]
        custom = locate_on_pattern(build_cloth(recording).mesh, uv).interpolate(x)
        task = PlanningTask([run], courses, Goal(custom, uv=torch.as_tensor(uv)), None, None)
        assert float(task.objectives[0].distance(x)) < 1e-9


def test_a_goal_of_another_cloth_leaves_the_journal_of_this_one(tmp_path):
    recording = make_hand_episode()
    (tmp_path / "kept").mkdir()
    (tmp_path / "kept" / "own.txt").write_text("stays")
    before = sorted(tmp_path.rglob("*"))
    beyond = Goal(torch.zeros(1, 3), uv=torch.tensor([[9.0, 0.0]]))
    with pytest.raises(InvalidInput, match="off the cloth"):
        tc.plan(build_nominal_cloth(recording), recording, beyond, journal=tmp_path / "kept", resume=False)
    assert sorted(tmp_path.rglob("*")) == before


def test_in_float32_too():
    torch.set_default_dtype(torch.float32)
    recording = make_hand_episode()
    cloth = build_nominal_cloth(recording)
    x = build_episode(cloth, recording, 20.0).initial
    result = tc.plan(cloth, recording, Goal(x + torch.tensor([0.06, 0.0, 0.0])), wait=WAIT, iterations=2)
    assert result.frames.dtype == torch.float32
    assert result.distance_after[0] < 0.5 * result.distance_before[0]


def test_in_float32_too_where_the_first_frame_is_between_knots():
    """Whole numbers may come from JSON, as 2.0."""
    torch.set_default_dtype(torch.float32)
    seen = rec.PointClouds(np.array([0.0, 0.1, 0.2]), np.tile([0.0, 0.1, 0.45], (3, 1)), np.ones(3, int))
    recording = replace(make_hand_episode(), points=seen, clock_offset=0.105)  # 0.105 is less in float32
    cloth = build_nominal_cloth(recording)
    x = build_episode(cloth, recording, 20.0).initial
    result = tc.plan(
        cloth, recording, Goal(x + torch.tensor([0.03, 0.0, 0.0])), wait=WAIT, waypoints=2.0, iterations=1.0
    )
    assert result.distance_after[0] < result.distance_before[0]


def test_two_hands_with_knots_of_their_own():
    recording = make_hand_episode()
    one = recording.grippers["hand"]
    t = np.linspace(0.0, DURATION_S, 13)
    place = np.stack([np.interp(t, one.t, custom) for custom in one.position.T], -1)
    other = rec.GripperMotion(t, place, np.tile([1.0, 0, 0, 0], (13, 1)), np.ones(13, bool))
    left, right = (
        rec.GraspInfo(uv=np.array([[0.0, 0.2]]), radius=0.04),
        rec.GraspInfo(uv=np.array([[0.2, 0.2]]), radius=0.04),
    )
    recording = replace(recording, grasps={"a": left, "b": right}, grippers={"a": one, "b": other})
    result = tc.plan(build_nominal_cloth(recording), recording, shifted_goal(recording), **QUICK)
    assert result.distance_after[0] < 0.4 * result.distance_before[0]
    assert set(result.motion) == {"a", "b"}
    assert len(result.motion["a"].t) == len(result.motion["b"].t)


def test_a_gripper_that_takes_hold_on_the_way_is_refused():
    recording = make_hand_episode()
    custom = recording.grippers["hand"]
    for closed, message in ((custom.t > 0.1, "after the first frame"), ((custom.t < 0.1) | (custom.t > 0.2), "again")):
        late = replace(recording, grippers={"hand": replace(custom, closed=closed)})
        with pytest.raises(InvalidInput, match=message):
            tc.plan(build_nominal_cloth(late), late, Goal(torch.zeros(4, 3)))


def test_waypoints_that_tremble_are_refused():
    recording = make_hand_episode()
    with pytest.raises(InvalidInput, match=r"waypoints.*0.1 s or more"):
        tc.plan(build_nominal_cloth(recording), recording, Goal(torch.zeros(4, 3)), waypoints=9)


def test_joints_that_no_arm_is_named_for_do_not_stay_beside_the_plan(tmp_path):
    recording = replace(make_arm_episode(), robots={})
    arm = tc.robots.load("rizon4", frame="tcp_closed")
    pose = arm(torch.as_tensor(recording.joints["arm"].q))
    path = tc.Trajectory(torch.as_tensor(recording.joints["arm"].t), pose, torch.ones(41, dtype=torch.bool))
    recording = replace(recording, grippers={"arm": to_gripper_motion(path)})
    result = tc.plan(build_nominal_cloth(recording), recording, shifted_goal(recording), wait=WAIT, iterations=1)
    assert not result.recording.joints
    result.save(tmp_path)
    assert rec.read(tmp_path / "episode").grippers["arm"].t[-1] == pytest.approx(DURATION_S + WAIT)


def test_an_episode_that_begins_in_mid_motion_says_so():
    recording = make_arm_episode()
    cloud = rec.PointClouds(np.array([0.1, 0.3]), np.tile(recording.cloth.initial_vertices[:5], (2, 1)), np.full(2, 5))
    late = replace(recording, points=cloud)
    result = tc.plan(
        build_nominal_cloth(late),
        late,
        Goal(torch.as_tensor(recording.cloth.initial_vertices)),
        waypoints=2,
        iterations=1,
    )
    assert any("under way" in text for text in result.warnings)
    assert result.times[0] == pytest.approx(0.1)
    assert result.recording.joints["arm"].t[0] == pytest.approx(0.1)


def test_a_goal_elsewhere_in_the_world_is_doubted():
    recording = make_hand_episode()
    result = tc.plan(
        build_nominal_cloth(recording), recording, shifted_goal(recording, torch.tensor([3.0, 0, 0])), iterations=1
    )
    assert any("in one world" in text for text in result.warnings)
