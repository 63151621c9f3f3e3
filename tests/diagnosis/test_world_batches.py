"""Worlds that differ in numbers only share a batch, and move as they do alone."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
import torch

import torchcloth as tc
from torchcloth.diagnosis.causes.hypotheses import list_hypotheses
from torchcloth.episodes.steps import central_steps
from torchcloth.episodes.world_batches import WorldRun, group_runs, simulate_group
from torchcloth.episodes.world_cache import WorldCache
from torchcloth.errors import UnstableStep
from torchcloth.identification.nuisances import GraspOffset

MAX_DIFFERENCE_M = 5e-6  # a batch takes the shortest of its substeps


@pytest.fixture(scope="module")
def runs(made):
    """Runs at shifted points, with shifted grasps, and with every hypothesis."""
    model, data = made
    worlds, episode = WorldCache(model, central_steps(model)), data.episodes[0]
    shifted = [WorldRun(world, episode) for world in worlds.shifted]
    modes = GraspOffset().initial_shape_modes(worlds.base.cloth, episode)
    grasps = [WorldRun(worlds.base, replace(episode, initial=episode.initial + 1e-3 * mode)) for mode in modes]
    changed = [worlds.with_typical(h) for h in list_hypotheses(model, [data.recordings[0]])]
    return [*shifted, *grasps, *(WorldRun(world, episode, may_fail=True) for world in changed if world)]


def test_batched_runs_are_those_of_each_alone(runs):
    groups = group_runs(runs)
    assert sorted(k for group in groups for k in group) == list(range(len(runs)))
    assert len(groups) < 0.7 * len(runs)
    for group in groups:
        if len(group) == 1:
            continue
        together = simulate_group([runs[k] for k in group])
        for k, frames in zip(group, together, strict=True):
            alone = runs[k].simulate()
            torch.testing.assert_close(frames.x, alone.x, rtol=0, atol=MAX_DIFFERENCE_M)
            for name, wrench in alone.wrench.items():
                assert (frames.wrench[name] - wrench).abs().max() < 1e-3 * wrench.abs().max()


def test_a_run_that_fails_takes_no_other_along(runs):
    def refuse(frames, episode):
        raise UnstableStep("dt", got="1 s", expected="less")

    good, other = runs[:2]
    bad = good._replace(world=good.world.with_observation_transform(refuse), may_fail=True)
    assert group_runs([good, bad, other]) == [[0, 1, 2]]
    frames = simulate_group([good, bad, other])
    assert frames[1] is None
    torch.testing.assert_close(frames[0].x, good.simulate().x, rtol=0, atol=0)
    with pytest.raises(UnstableStep):
        simulate_group([good, bad._replace(may_fail=False)])


def test_a_users_part_is_in_no_batch(runs):
    """It may keep its amplitude where no fingerprint looks."""

    class Push(tc.effects.AbstractEffect):
        def __init__(self, size):
            super().__init__()
            self._size = size

        def coefficients(self):
            return None

    worlds = [runs[0].world.with_cloth({"push": Push(size)}) for size in (1.0, -1.0)]
    assert len(group_runs([WorldRun(world, runs[0].episode) for world in worlds])) == 2


def test_threads_may_simulate_a_world_while_it_is_in_a_batch(runs):
    """Its own parameters never change."""
    (group,) = (group for group in group_runs(runs) if 0 in group)
    alone = runs[0].simulate()
    with ThreadPoolExecutor(4) as pool:
        batches = [pool.submit(simulate_group, [runs[k] for k in group]) for _ in range(3)]
        singles = [pool.submit(runs[0].simulate) for _ in range(30)]
    for single in singles:
        torch.testing.assert_close(single.result().x, alone.x, rtol=0, atol=0)
    for batch in batches:
        torch.testing.assert_close(batch.result()[0].x, alone.x, rtol=0, atol=MAX_DIFFERENCE_M)
