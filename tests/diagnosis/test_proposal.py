"""Proposed experiments can be carried out by the independent engine and distinguish causes."""

import json
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import linear_evidence as toys
from helpers import sheet_episodes
from helpers.undecided_search import make_undecided_search

from torchcloth.diagnosis import build_base_model, prepare_data
from torchcloth.diagnosis.data.dataset import extend_for_clock
from torchcloth.diagnosis.decide.criteria import CRITERIA
from torchcloth.diagnosis.experiment import proposal
from torchcloth.diagnosis.experiment.motions import (
    EXPERIMENTS,
    MOTIONS,
    Experiment,
    list_experiments,
    make_episode,
    measure_heading,
)
from torchcloth.diagnosis.experiment.proposal import (
    OpenQuestion,
    compute_chi2,
    compute_information,
    find_open_question,
    propose_experiment,
    simulate_measurements,
    simulate_whitened_slopes,
)
from torchcloth.diagnosis.inference.linearise import central_differences
from torchcloth.episodes.observed import build_episode
from torchcloth.recordings import Collider

PRINT_MOTIONS_SCRIPT = """
import json, sys
from torchcloth.training.validation.independent.flex_sheet import SheetSpec
from torchcloth.training.validation.independent.motions import make_motion
sheet = SheetSpec(0.2, 0.2, areal_density=0.2, membrane_stiffness=60.0, damping_time=1e-4)
found = []
for name, heading, speed in json.loads(sys.argv[1]):
    m = make_motion(name, sheet, heading, speed)
    found.append({n: p[:, :3, 3].tolist() for n, p in m.pose.items()})
print(json.dumps(found))
"""


def test_the_library_is_that_of_the_independent_engine():
    """Displacements and turns of both grippers, by the other code."""
    template = sheet_episodes.make_episode()
    own = float(np.rad2deg(measure_heading(template)))
    asked = json.dumps([[e.motion, e.heading + own, e.speed] for e in EXPERIMENTS])
    run = [sys.executable, "-c", PRINT_MOTIONS_SCRIPT, asked]
    out = subprocess.run(run, capture_output=True, text=True, check=True).stdout
    for experiment, paths in zip(EXPERIMENTS, json.loads(out), strict=True):
        plan = make_episode(experiment, template)
        own = np.stack([plan.grippers[n].position for n in ("left", "right")])
        other = np.stack([np.asarray(paths[n]) for n in ("left", "right")])
        assert own.shape == other.shape, experiment
        np.testing.assert_allclose(own.mean(0) - own.mean(0)[0], other.mean(0) - other.mean(0)[0], atol=1e-9)
        apart, said = (np.linalg.norm(p[0] - p[1], axis=-1) for p in (own, other))
        np.testing.assert_allclose(apart - apart[0], said - said[0], atol=1e-9)
        along = lambda p: np.arctan2(*(p[0] - p[1])[:, [1, 0]].T)  # noqa: E731
        np.testing.assert_allclose(np.cos(along(own) - along(other)), 1.0, atol=1e-9)


def test_an_experiment_begins_as_the_episode_that_it_repeats_and_is_turned_from_there():
    template = sheet_episodes.make_episode()
    begun = {n: np.asarray(g.position[0]) for n, g in template.grippers.items()}
    centre = np.mean(list(begun.values()), axis=0)
    for heading in (0.0, 90.0):
        plan = make_episode(Experiment("swing", heading), template)
        c, s = np.cos(np.deg2rad(heading)), np.sin(np.deg2rad(heading))
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        for name, place in begun.items():
            np.testing.assert_allclose(plan.grippers[name].position[0], turn @ (place - centre) + centre, atol=1e-9)
        way = np.ptp(plan.grippers["left"].position, axis=0)
        edge = np.abs(turn @ (begun["left"] - begun["right"]))
        assert way @ edge == pytest.approx(0.0, abs=1e-9)  # square to the edge
        assert way.max() > 0.04
    named = replace(template, grippers={"b": template.grippers["left"], "a": template.grippers["right"]}, grasps={})
    assert abs(abs(measure_heading(named) - measure_heading(template)) - np.pi) < 1e-9  # hanging: either side


def test_cloth_that_lies_is_dragged_away_from_where_it_lies():
    hanging = sheet_episodes.make_episode()
    flat = np.asarray(hanging.cloth.initial_vertices)
    own = measure_heading(hanging)
    for side in (-1.0, 1.0):
        down = side * (flat[..., 2:].max() - flat[..., 2:]) * np.array([np.cos(own), np.sin(own), 0.0])
        lying = np.concatenate([flat[..., :2], 0 * flat[..., 2:]], -1) + down
        table = {"table": Collider(np.zeros(3), np.array([0.0, 0.0, 1.0]))}
        recording = replace(hanging, cloth=replace(hanging.cloth, initial_vertices=lying), colliders=table)
        way = make_episode(Experiment("drag"), recording).grippers["left"].position
        assert (way[-1] - way[0]) @ down.reshape(-1, 3).mean(0) < 0


def test_only_what_can_be_begun_is_asked_for():
    hanging = [str(e) for e, _ in list_experiments([sheet_episodes.make_episode()])]
    assert len(hanging) == sum(not MOTIONS[e.motion].lying for e in EXPERIMENTS)
    assert "swing, grippers and cloth turned by 90 degrees" in hanging
    assert list_experiments([]) == []


def test_distances_are_those_of_two_columns():
    """What chi^2 is left of i's effect when j does its best, by least squares, beyond what engines may differ by."""
    slopes = toys.draw_jacobian(5, 6)  # 2 own, 3 hypotheses, a nuisance
    found = toys.make_model_fit(toys.draw_linearisation(slopes, 2, ["a", "b", "c"], torch.zeros(5).double(), 0))
    question = OpenQuestion(found, {"c": 0.7, "a": 0.4}, (("c", "a"),))
    told = compute_chi2(question, compute_information(question, []))[("c", "a")]
    white, prior = found.whitened.jacobian, 2.0 * torch.eye(2).double()
    fitted = torch.cat([white[:, :2], prior])

    def left(columns, target):
        best = torch.linalg.lstsq(columns, target[:, None]).solution
        return float((target[:, None] - columns @ best).square().sum())

    def wide(k):
        return torch.cat([white[:, 2 + k], torch.zeros(2).double()])

    def beyond(j, target):
        remaining = left(torch.cat([fitted, wide(j)[:, None]], 1), target)
        return remaining - CRITERIA.candidate.simulator_tolerance * left(fitted, target)

    one, other = beyond(0, 0.7 * wide(2)), beyond(2, 0.4 * wide(0))
    assert told == pytest.approx(min(one, other), rel=1e-6)
    again = white[: len(white) // 2][:, [0, 1, 4, 2]]
    more = compute_chi2(question, compute_information(question, [again]))[("c", "a")]
    assert more > told


def smooth(*of):
    """As if no cloth rippled."""
    found = central_differences(*of)
    return found._replace(roughness=torch.zeros_like(found.roughness))


@pytest.mark.parametrize("said", ["causes", "minor"])
def test_gravity_and_camera_are_told_apart_by_turning(said, monkeypatch):
    """A sheet that leans with the room and one that the camera sees leaning turn apart when the sheet is turned.

    Its edge is along y here, where it hangs with a lean along y edgewise.
    """
    found, content, setting = make_undecided_search(("env.gravity_tilt[y]", "obs.rotation[x]"), said)
    question = find_open_question(found, content)
    now = compute_chi2(question, compute_information(question, []))
    told = {}
    for name in ("hang", "turn"):
        slopes = simulate_whitened_slopes(
            question, make_episode(Experiment(name, -90.0), setting.recordings[0]), setting
        )
        told[name] = min(compute_chi2(question, compute_information(question, [slopes])).values())
    monkeypatch.setattr(proposal, "central_differences", smooth)
    calm = simulate_whitened_slopes(question, make_episode(Experiment("turn", -90.0), setting.recordings[0]), setting)
    assert (
        min(compute_chi2(question, compute_information(question, [calm])).values()) > told["turn"]
    )  # ripples tell less
    least = min(now.values())
    assert told["turn"] - least > 10 * (told["hang"] - least) >= 0


def test_nothing_open_asks_for_nothing():
    end = toys.make_model_fit(
        toys.draw_linearisation(toys.draw_jacobian(5, 4), 1, ["a", "b"], torch.zeros(3).double(), 0)
    )
    found, none = SimpleNamespace(causes=[], minor=[], scores=[], end=end), {"causes": [], "minor": []}
    assert propose_experiment(found, none, SimpleNamespace(recordings=()), print) is None


def test_what_does_the_same_as_a_fitted_number_is_not_waited_for():
    """No motion tells a density from the fabric's own; its data sheet alone does."""
    end = toys.make_model_fit(
        toys.draw_linearisation(toys.draw_jacobian(5, 4), 1, ["a", "b"], torch.zeros(3).double(), 0)
    )
    twin, other = (
        replace(toys.make_hypothesis("a"), equivalent_parameter=end.model.parameters[0].name),
        toys.make_hypothesis("b"),
    )
    end = replace(end, linearisation=replace(end.linearisation, hypotheses=[twin, other]))
    rows = [SimpleNamespace(hypothesis=h, decision="inconclusive") for h in (twin, other)]
    found, none = SimpleNamespace(causes=[], minor=[], scores=rows, end=end), {"causes": [], "minor": []}
    assert find_open_question(found, none).amplitudes.keys() == {"b"}
    found.scores = rows[:1]
    assert find_open_question(found, none) is None


def test_an_experiment_feels_what_the_data_felt():
    """Forces without torques are no torques that would be felt."""
    seen = sheet_episodes.record_changed_world("slow", lambda world: world, 0)
    pulled = {name: replace(g, force=np.tile([0, 0, -0.04], (len(g.t), 1))) for name, g in seen.grippers.items()}
    seen = replace(seen, grippers=pulled)
    model = build_base_model(seen)
    setting = prepare_data(model, [seen])
    blank = extend_for_clock(
        build_episode(model.base.cloth, replace(make_episode(Experiment("hang"), seen), joints={}))
    )
    felt = simulate_measurements(model.build_world().simulate_observed(blank), blank, setting).wrenches["left"]
    assert felt[1:, :3].isfinite().all()
    assert felt[:, 3:].isnan().all()
