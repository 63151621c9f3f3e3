"""Worlds at and around a model's point are built once and equal those that the model builds."""

from concurrent.futures import ThreadPoolExecutor

import pytest
from helpers import sheet_episodes

from torchcloth.diagnosis.causes.hypotheses import list_hypotheses
from torchcloth.diagnosis.models.base_model import build_base_model
from torchcloth.episodes.steps import central_steps, shift_model
from torchcloth.episodes.world import Hypothesis
from torchcloth.episodes.world_cache import WorldCache
from torchcloth.errors import InvalidInput

RECORDING = sheet_episodes.make_episode()


@pytest.fixture
def model():
    return build_base_model(RECORDING)


def numbers(world):
    return [p.tolist() for p in world.cloth.parameters()]


def test_they_are_those_of_the_model(model):
    shifts = central_steps(model)
    worlds = WorldCache(model, shifts, model.base)
    assert numbers(worlds.base) == numbers(worlds.fine) == numbers(model.build_world())
    assert [numbers(w) for w in worlds.shifted] == [numbers(shift_model(model, *s).build_world()) for s in shifts]
    drag = next(h for h in list_hypotheses(model, [RECORDING]) if h.name == "air.drag_n")
    changed = worlds.with_typical(drag)
    assert changed is not None
    assert numbers(changed) == numbers(drag.apply(model.build_world(), drag.typical))


def test_each_is_made_once_by_many_threads(model):
    worlds, calls = WorldCache(model, central_steps(model)), []

    def apply(world, amplitude):
        calls.append(amplitude)
        return world

    both = [Hypothesis("a", "-", 2.0, apply, signed=True), Hypothesis("a", "-", -2.0, apply, signed=True)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda k: worlds.with_typical(both[k % 2]), range(40)))
        plain = set(map(id, pool.map(lambda _: worlds.base, range(40))))
    assert sorted(calls) == [-2.0, 2.0]
    assert len(plain) == 1
    assert [id(w) for w in worlds.shifted] == [id(w) for w in worlds.shifted]


def test_what_no_world_allows_is_none(model):
    def apply(world, amplitude):
        calls.append(amplitude)
        raise InvalidInput("grip", got="too wide", expected="less")

    calls = []
    worlds, never = WorldCache(model), Hypothesis("a", "-", 1.0, apply)
    assert worlds.with_typical(never) is worlds.with_typical(never) is None
    assert calls == [1.0]
