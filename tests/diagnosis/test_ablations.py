"""What the method would get wrong without each of its parts: ablations that must hurt."""

from dataclasses import replace

import torch
from helpers import linear_evidence as toys
from helpers import sheet_episodes

from torchcloth.diagnosis.causes.hypotheses import list_hypotheses
from torchcloth.diagnosis.data.dataset import prepare_data
from torchcloth.diagnosis.inference.screening import screen
from torchcloth.diagnosis.models.base_model import build_base_model

NAMES = ["a", "b", "c"]
SLOPES = toys.draw_jacobian(1, 6)  # two parameters, three hypotheses, one nuisance
SEEDS = range(40)


def made(truth=(0.0, 0.0, 0.0), seed=0):
    """Evidence in which the hypotheses have these amplitudes."""
    return toys.draw_linearisation(SLOPES, 2, NAMES, torch.tensor([0.0, 0.0, *truth]).double(), seed)


def present(found) -> int:
    return sum(row.decision == "present" for row in screen(found))


def test_independent_noise_would_raise_false_alarms():
    """With slow errors taken for white ones, nulls look like effects."""
    wrong = right = 0
    for seed in SEEDS:
        ev = made(seed=seed)
        wrong += sum(abs(r.amplitude) > 2.58 * r.std for r in screen(toys.make_model_fit(ev, level=1e-9)))
        right += sum(abs(r.amplitude) > 2.58 * r.std for r in screen(toys.make_model_fit(ev)))
    assert right <= 5  # of 120 at 1 %: more than 5 has a chance of 1 in 300
    assert wrong > 5 * max(right, 1)


def test_without_nuisances_what_differs_from_episode_to_episode_would_be_a_cause():
    """A clock that is off by up to two standard deviations, and always to one side."""
    slopes, std = SLOPES.clone(), 0.6
    slopes[..., -1] = slopes[..., -2]  # as "c" is asked about for all episodes together
    wrong = right = 0
    for seed in SEEDS:
        ev = toys.draw_linearisation(slopes, 2, NAMES, torch.zeros(5).double(), seed)
        off = [std * x for x in (2.0, 2.0, 0.5, 1.5)]
        cells = [c._replace(value=c.value + x * c.jacobian[:, -1]) for c, x in zip(ev.bins, off, strict=True)]
        right += present(
            toys.make_model_fit(replace(ev, bins=cells, nuisance_stds=[torch.tensor([std]).double()] * len(off)))
        )
        wrong += present(
            toys.make_model_fit(replace(ev, bins=cells, nuisance_stds=[torch.tensor([1e-9]).double()] * len(off)))
        )
    assert right == 0
    assert wrong > 30


def test_without_projection_a_wrong_fabric_would_be_a_cause():
    """What fitted parameters could do is not left to the hypotheses."""
    slopes = SLOPES.clone()
    slopes[..., 3] += 0.5 * slopes[..., 0]  # "b" does a part of what the first parameter does
    wrong = right = 0
    for seed in SEEDS:
        ev = toys.draw_linearisation(slopes, 2, NAMES, torch.tensor([3.0, 0.0, 0.0, 0.0, 0.0]).double(), seed)
        right += present(toys.make_model_fit(ev, std=10.0))
        wrong += present(toys.make_model_fit(ev, std=1e-3))  # nothing may give way
    assert right == 0
    assert wrong > 30


def test_tested_against_zero_what_does_not_matter_would_be_a_cause():
    """A fifth of a typical amplitude is surely there, and no reason to change a model."""
    wrong = right = 0
    for seed in SEEDS:
        found = toys.make_model_fit(made((0.0, 0.2, 0.0), seed))
        right += present(found)
        anything = [replace(h, smallest_fraction=0.0) for h in found.linearisation.hypotheses]
        wrong += present(replace(found, linearisation=replace(found.linearisation, hypotheses=anything)))
    assert right == 0
    assert wrong > 30


def test_on_one_mesh_what_a_mesh_does_would_be_a_cause():
    """The difference between two meshes, which looks like b, is half as large as is left on the finer one."""
    ev = made((0.0, 0.6, 0.0))
    other = [-1.5 * c.jacobian[:, 3] for c in ev.bins]
    assert present(toys.make_model_fit(ev)) == 1
    assert present(toys.make_model_fit(replace(ev, mesh_differences=other))) == 0


def test_a_tangent_would_not_see_what_begins_slowly(monkeypatch):
    """Wind pushes by its square: at a hundredth of a typical one cloth that hangs still feels nothing."""
    monkeypatch.setitem(sheet_episodes.MOTIONS, "still", sheet_episodes.make_swing(0.0, 1.0))
    recording = sheet_episodes.make_episode("still", duration=0.5)
    model = build_base_model(recording)
    setting = prepare_data(model, [recording])
    (wind,) = (h for h in list_hypotheses(model, [recording]) if h.name == "air.wind[y]")
    moved = lambda a: model.build_world([(wind, a * wind.typical)]).simulate_observed(setting.episodes[0]).x  # noqa: E731
    still = moved(1e-6)  # any wind brings its drag along
    tangent, secant = (moved(0.01) - still) / 0.01, moved(1.0) - still
    assert float(secant.norm()) > 10 * float(tangent.norm())
