"""Causes that act in folds have their slopes on the finer mesh, each in its own column."""

from dataclasses import replace

import pytest
import torch
from helpers import sheet_episodes

from torchcloth._utils.caching import LRUCache
from torchcloth.diagnosis.causes.hypotheses import list_hypotheses
from torchcloth.diagnosis.data.binning import align_rows, bin_residuals, finite_differences
from torchcloth.diagnosis.data.fine_mesh import refine_model
from torchcloth.diagnosis.inference.episode_simulation import run_episode
from torchcloth.diagnosis.inference.linearise import linearise, linearise_hypotheses
from torchcloth.diagnosis.models.base_model import build_base_model
from torchcloth.episodes.world import World
from torchcloth.episodes.world_cache import WorldCache
from torchcloth.identification.nuisances import GraspOffset

RECORDING = sheet_episodes.make_episode()


@pytest.fixture(scope="module")
def asked(made):
    """Three of the catalogue; the middle one only on the finer mesh."""
    by = {h.name: h for h in list_hypotheses(made[0], [RECORDING])}
    return [by["air.drag_n"], replace(by["bend.aniso"], needs_fine_mesh=True), by["mass.hem"]]


def on_finer(made, hypothesis, key):
    """Slopes by simulations of the finer mesh alone, for the cells of ``key``."""
    model, setting = made
    finer, world = setting.fine_mesh, refine_model(model, [RECORDING])[0].build_world()
    e = finer.episodes[0]
    base, moved = world.simulate_observed(e), hypothesis.apply(world, hypothesis.typical).simulate_observed(e)
    found = bin_residuals(
        base, finite_differences(base, [moved], [hypothesis.typical]), e, finer.surface, finer.rest_positions
    )
    return align_rows(key, found.key, found.jacobian)[:, 0]


def test_creases_are_one():
    model = build_base_model(RECORDING)
    assert [h.name for h in list_hypotheses(model, [RECORDING]) if h.needs_fine_mesh] == ["plast.crease"]


def test_its_column_is_of_the_finer_mesh_and_the_others_as_before(made, asked):
    model, setting = made
    found, usual = (
        linearise(model, setting, asked),
        linearise(model, setting, [replace(h, needs_fine_mesh=False) for h in asked]),
    )
    place = found.n_coordinates + 1
    own = found.bins[0].jacobian[:, place]
    assert torch.equal(own, on_finer(made, asked[1], found.bins[0].key))
    changed = [k for k in range(usual.bins[0].jacobian.shape[1]) if k != place]
    assert torch.equal(found.bins[0].jacobian[:, changed], usual.bins[0].jacobian[:, changed])
    assert not torch.allclose(own, usual.bins[0].jacobian[:, place], rtol=1e-3)


def test_who_asks_later_is_told_the_same(made, asked):
    model, setting = made
    at_once, known = linearise(model, setting, asked), linearise(model, setting, asked[:1])
    later = linearise_hypotheses(known, model, setting, asked)
    assert torch.equal(at_once.bins[0].jacobian, later.bins[0].jacobian)


@pytest.mark.parametrize(("memory", "again"), [(2**30, 0), (0, 2)])
def test_the_point_itself_is_simulated_once(made, asked, monkeypatch, memory, again):
    """On both meshes; beside it each of three causes, one of them on the finer mesh, too."""
    model, setting = made[0], replace(made[1], recent_frames=LRUCache(memory, lambda frames: 1))
    known, simulate, simulated = linearise(model, setting, asked[:1]), World.simulate, []

    def counted(world, *arguments):
        simulated.append(world)
        return simulate(world, *arguments)

    monkeypatch.setattr(World, "simulate", counted)
    later = linearise_hypotheses(known, model, setting, asked)
    assert len(simulated) == 4 + again
    assert torch.equal(later.bins[0].jacobian, linearise_hypotheses(known, model, setting, asked).bins[0].jacobian)


def test_an_accepted_one_keeps_its_mesh(made, asked):
    """Beside a small amplitude, too: its own column is about what it was asked by, from the finer mesh."""
    model, setting = made
    cause = replace(asked[1], step_fraction=1.0)  # slopes by the typical amplitude, both ways
    found = linearise(model.with_hypothesis(cause), setting)
    place = len(model.point)
    column = 0.5 * sum(
        on_finer(made, replace(cause, typical=sign * cause.typical), found.bins[0].key) for sign in (1.0, -1.0)
    )
    slope = found.bins[0].jacobian[:, place]
    assert (slope - column).norm() < 0.02 * column.norm()  # two runs of a batch have the shorter of their substeps


def test_without_a_finer_mesh_it_is_as_the_others(made, asked):
    """As where experiments are planned."""
    model, setting = made
    done = run_episode(WorldCache(model), setting.episodes[0], None, asked, with_grasp_shifts=False)
    coarse = asked[1].apply(model.build_world(), asked[1].typical).simulate_observed(setting.episodes[0])
    assert torch.equal(done.with_hypotheses[1].x, coarse.x)


def test_what_does_nothing_on_the_given_mesh_is_not_simulated_on_the_finer(made, asked):
    model, setting = made
    (crease,) = (h for h in list_hypotheses(model, [RECORDING]) if h.name == "plast.crease")
    e, finer = setting.episodes[0], (setting.fine_mesh.episodes[0], None)
    worlds = WorldCache(model, (), setting.fine_mesh.base)
    slack = replace(crease, apply=lambda world, amplitude: world.with_cloth())  # another cloth, which moves alike
    none, some = (
        run_episode(worlds, e, None, [h], with_grasp_shifts=False, fine_episode=finer) for h in (slack, asked[1])
    )
    assert (none.fine, none.fine_hypotheses) == (None, set())
    assert some.fine is not None
    assert some.fine_hypotheses == {0}


def test_cells_that_are_seen_for_the_first_time_have_slopes_along_nuisances(made):
    """All but those of grasps, which would take simulations: else they would seem surer than all others."""
    model, setting = made
    whole = linearise(model, setting)
    first = whole.bins[0]
    places = torch.arange(len(first.key)) % 5 == 0
    less = replace(whole, bins=[c.select(~places) if k == 0 else c for k, c in enumerate(whole.bins)])
    again = linearise(model, setting, before=less).bins[0]
    grasps = len(GraspOffset().initial_shape_modes(model.base.cloth, setting.episodes[0]))
    assert torch.equal(again.key, first.key)
    count = again.jacobian.shape[1] - grasps
    assert torch.equal(again.jacobian[:, :count], first.jacobian[:, :count])
    assert not again.jacobian[places, count:].any()
    assert torch.equal(again.jacobian[~places, count:], first.jacobian[~places, count:])
