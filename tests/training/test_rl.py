"""The environment of ``torchcloth plan``'s scenes, and a learner in it."""

import gymnasium
import numpy as np
import pytest
import torch
from helpers.planning_scenes import build_nominal_cloth, make_arm_episode, make_hand_episode

from torchcloth.errors import InvalidInput, SimulationDiverged
from torchcloth.planning import Goal
from torchcloth.planning.episode_conversion import extract_motion_parameters
from torchcloth.planning.forward_model import ForwardModel, exact_model
from torchcloth.planning.task import PlanningTask
from torchcloth.robots import DEFAULT_JOINT_ACCELERATION
from torchcloth.robots.primitives import GripperLimits
from torchcloth.training.rl import ReachEnv, ReachVectorEnv, learn
from torchcloth.training.rl.env import StepwiseSpline, make_stepwise

WAIT = 0.1


def task_of(recording, way=(0.04, 0.02, 0.03), waypoints=2, judge=None):
    """Where the recorded motion's cloth would be if all were shifted."""
    cloth = build_nominal_cloth(recording).requires_grad_(False)
    courses = [
        make_stepwise(c)
        for c in extract_motion_parameters(
            cloth, recording, waypoints, WAIT, DEFAULT_JOINT_ACCELERATION, GripperLimits()
        )
    ]
    run = ForwardModel(exact_model(cloth), recording, courses, None)
    with torch.no_grad():
        x = run.simulate({c.name: c.trajectory(c.zero_waypoints) for c in courses})[-1]
    return PlanningTask([run], courses, Goal(x + torch.tensor(way), run.faces), judge, None)


def test_a_step_is_done_in_its_own_stretch_of_time():
    span = StepwiseSpline(0.0, 1.0, 4)
    share = span.basis(torch.tensor([0.0, 0.25, 0.5, 1.0, 2.0]))
    assert torch.allclose(share[1], torch.tensor([1.0, 0, 0, 0]))
    assert torch.allclose(share[2], torch.tensor([1.0, 1, 0, 0]))
    assert torch.allclose(share[3:], torch.ones(2, 4))


@pytest.mark.parametrize("scene", [make_hand_episode, make_arm_episode])
def test_it_is_an_environment(scene):
    from gymnasium.utils.env_checker import check_env

    check_env(ReachEnv(task_of(scene())), skip_render_check=True)


@pytest.mark.long
def test_the_registered_environment_is_clean():
    from gymnasium.utils.env_checker import check_env

    env = gymnasium.make("torchcloth/Reach-v0", garment="dress", seed=1)
    check_env(env.unwrapped, skip_render_check=True)


@pytest.mark.long
def test_scenes_of_a_batch_move_as_alone():
    batch = gymnasium.make_vec("torchcloth/Reach-v0", num_envs=3, garment="dress")
    alone = batch.env
    actions = np.random.default_rng(0).uniform(-0.5, 0.5, (2, 3, alone.count)).astype(np.float32)
    observations, _ = batch.reset(seed=0)
    assert observations.shape == batch.observation_space.shape
    for k in range(2):
        observations, rewards, over, _, infos = batch.step(actions[k])
    assert over.all()
    assert np.array_equal(observations[0], alone.reset()[0])  # reset in the same step
    for i in range(2):
        alone.reset()
        alone.step(actions[0, i])
        observation, reward, _, _, _ = alone.step(actions[1, i])
        assert rewards[i] == pytest.approx(reward, rel=1e-3)
        assert infos["final_obs"][i] == pytest.approx(observation, abs=0.05)  # chaos of the last digits


def test_a_torn_scene_of_a_batch_ends_alone(monkeypatch):
    tried = []
    batch = ReachVectorEnv(ReachEnv(task_of(make_hand_episode())), 2, tried.append)
    whole = batch.env.run.simulate_interval

    def tear(state, motion, begin, end):
        if any(float(path.pose[..., -1, 0, 3].max()) > limit for path in motion.values()):
            raise SimulationDiverged("torn")
        return whole(state, motion, begin, end)

    batch.reset()
    first = batch.env.task.motion(batch.env.task.start)
    limit = max(float(path.pose[-1, 0, 3]) for path in first.values()) + 1e-3
    monkeypatch.setattr(batch.env.run, "simulate_interval", tear)
    push = np.zeros((2, batch.env.count))
    push[1, 0] = push[1, batch.env.count // 2] = 1.0
    _, rewards, over, _, _ = batch.step(push)
    assert over.tolist() == [False, True]
    assert rewards[1] < -1 < 0 > rewards[0]
    assert [t.distance for t in tried] == [np.inf]
    with pytest.raises(InvalidInput, match="num_envs"):
        ReachVectorEnv(batch.env, 0)


@pytest.mark.long
def test_sac_learns_on_a_batch_of_scenes():
    result = learn(task_of(make_hand_episode()), motions=10, random_motions=4, scenes=4)
    assert len(result.history) == len(result.seconds) == 11
    assert result.seconds == sorted(result.seconds)


def test_of_an_episode_it_is_what_is_planned_in():
    recording, wanted = make_arm_episode(), task_of(make_arm_episode(), waypoints=3)
    cloth = build_nominal_cloth(recording).requires_grad_(False)
    env = ReachEnv.of(cloth, recording, wanted.goal, waypoints=3, wait=WAIT)
    assert env.intervals == 3
    assert env.task.evaluate(env.task.start) == wanted.evaluate(wanted.start)
    with pytest.raises(InvalidInput, match="waypoints"):
        ReachEnv.of(cloth, recording, wanted.goal, waypoints=0)
    with pytest.raises(InvalidInput, match="one Cloth"):
        ReachEnv.of([cloth, cloth], recording, wanted.goal)
    with pytest.warns(UserWarning, match="in one world"):
        ReachEnv.of(cloth, recording, Goal(wanted.goal.points + 30.0))


def test_step_by_step_the_cloth_goes_where_the_whole_motion_brings_it():
    task = task_of(make_arm_episode(), waypoints=3)
    tried = []
    env = ReachEnv(task, tried.append)
    env.reset()
    actions = np.random.default_rng(0).uniform(-1, 1, (3, env.count))
    for k, action in enumerate(actions):
        _, reward, over, _, info = env.step(action)
        assert over == (k == 2)
        assert reward == pytest.approx(-info["distance"] / env.recorded_distance)
    (last,) = tried
    assert last.distance == pytest.approx(info["distance"])
    assert task.evaluate(last.at)[0] == pytest.approx(last.distance, rel=2e-2)  # substeps of other lengths
    assert float(task.bounds.nearest_limit(last.at)[0]) <= 1.0


def test_what_is_in_the_way_is_not_stepped_into():
    class Wall:
        def smallest_gap(self, q):
            return None, "in the way" if float((q["arm"] - recorded).abs().max()) > 0.02 else None

    course = task_of(make_arm_episode()).motions[0]
    recorded = course.coordinates_at_check_times(course.zero_waypoints)

    env = ReachEnv(task_of(make_arm_episode(), judge=Wall()))
    env.reset()
    for _ in range(2):
        env.step(np.ones(env.count))
    assert torch.equal(env.at, env.task.start)


def test_a_motion_that_cannot_be_simulated_ends_there(monkeypatch):
    tried = []
    env = ReachEnv(task_of(make_hand_episode()), tried.append)

    def torn(*arguments):
        raise SimulationDiverged("torn")

    monkeypatch.setattr(env.run, "simulate_interval", torn)
    env.reset()
    _, reward, over, _, _ = env.step(np.zeros(env.count))
    assert over
    assert reward < -1
    assert reward <= -5.0 * env.intervals  # to tear the cloth at once spares nothing
    assert tried[0].distance == np.inf
    assert env.reset()[0].shape == env.observation_space.shape


def test_sac_comes_nearer():
    found = learn(task_of(make_hand_episode()), motions=60, random_motions=20)
    assert len(found.history) == 61
    assert found.history[-1] == found.policy
    assert min(found.history) < 0.6 * found.history[0]
    assert torch.get_default_dtype() == torch.float64
