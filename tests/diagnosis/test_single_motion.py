"""One motion: what would explain it is ranked, and no cause is named."""

from types import SimpleNamespace

import pytest
import torch
from helpers import linear_evidence as toys
from helpers import sheet_episodes

from torchcloth.diagnosis import build_base_model, diagnose, list_hypotheses
from torchcloth.diagnosis.decide import search as search_module
from torchcloth.diagnosis.decide.in_sample import rank_in_sample
from torchcloth.diagnosis.decide.search import SearchResult, search
from torchcloth.diagnosis.experiment import proposal
from torchcloth.diagnosis.experiment.feasibility import FeasibleExperiment
from torchcloth.diagnosis.experiment.motions import Experiment
from torchcloth.diagnosis.experiment.proposal import find_open_question, propose_experiment
from torchcloth.diagnosis.inference.comparison import has_held_out_motions
from torchcloth.diagnosis.inference.screening import screen
from torchcloth.diagnosis.report.wording import VERDICTS, describe_next_step, write_sentences

NAMES = ["a", "like a", "c"]
HIDDEN_A = 0.5


def make_result(truth, motions, alike=0.02):
    """Return the search of one parameter and three hypotheses, of which the first two have almost the same slopes."""
    jacobian = toys.draw_jacobian(5, 5)[: len(motions)]
    jacobian[..., 2] = jacobian[..., 1] + alike * jacobian[..., 2]
    fitted = toys.make_model_fit(toys.draw_linearisation(jacobian, 1, NAMES, torch.tensor(truth).double(), 0))
    data = SimpleNamespace(motions=motions)
    return SearchResult(fitted, fitted, [], screen(fitted), None, None, 0.0, 0.0, None, data)  # type: ignore[arg-type]


def test_what_explains_a_single_motion_is_ranked_with_what_explains_it_as_well():
    best, *others = rank_in_sample(make_result([0.0, HIDDEN_A, 0.0, 0.0], ["swing"]))
    assert {best.score.hypothesis.name, others[0].score.hypothesis.name} == {"a", "like a"}
    assert abs(best.score.step_amplitude) == pytest.approx(HIDDEN_A, rel=0.2)
    assert [e.explains_as_well for e in (best, others[0])] == [True, True]
    assert not any(e.explains_as_well for e in others[1:])


def test_nothing_is_ranked_where_nothing_is_wrong_or_a_motion_is_held_out():
    assert rank_in_sample(make_result([0.0, 0.0, 0.0, 0.0], ["swing"])) == []
    assert rank_in_sample(make_result([0.0, HIDDEN_A, 0.0, 0.0], ["swing", "turn"])) == []


def test_repetitions_of_one_motion_are_a_single_motion():
    episode = torch.tensor([0, 0, 1, 1])
    assert not has_held_out_motions(episode, ["swing", "swing"])
    assert has_held_out_motions(episode, ["swing", "turn"])
    assert not has_held_out_motions(episode, ["swing", "swing", "turn"])  # nothing was observed in the last


def test_the_next_motion_distinguishes_what_explains_a_single_one_as_well():
    result = make_result([0.0, HIDDEN_A, 0.0, 0.0], ["swing"], alike=0.3)
    rows = [explanation.as_dict() for explanation in rank_in_sample(result)]
    question = find_open_question(result, {"causes": [], "minor": [], "in_sample": rows})
    assert question is not None
    names = [row["effect"] for row in rows]
    assert question.pairs == tuple((names[0], other) for other in names[1:])
    assert question.amplitudes[names[0]] == rows[0]["amplitude"]
    alone = find_open_question(result, {"causes": [], "minor": [], "in_sample": rows[:1]})
    assert alone is not None
    assert (alone.pairs, list(alone.amplitudes)) == ((), names[:1])


@pytest.mark.parametrize(("single", "tried"), [(True, ["turn"]), (False, ["swing", "turn"])])
def test_the_motion_that_was_recorded_is_no_other_motion(monkeypatch, single, tried):
    result = make_result([0.0, HIDDEN_A, 0.0, 0.0], ["swing"], alike=0.3)
    rows = [explanation.as_dict() for explanation in rank_in_sample(result)]
    content = {"causes": [], "minor": [], "in_sample": rows, "single_motion": single}
    choices = [FeasibleExperiment(Experiment(name), sheet_episodes.make_episode()) for name in ("swing", "turn")]
    simulated = []

    def simulate(question, *_):
        simulated.append(1)
        columns = result.end.linearisation.n_coordinates + len(question.amplitudes)
        return torch.randn(40, columns, generator=torch.Generator().manual_seed(0)).double()

    said = []
    monkeypatch.setattr(proposal, "check_feasibility", lambda *_: choices)
    monkeypatch.setattr(proposal, "simulate_whitened_slopes", simulate)
    answer = propose_experiment(result, content, SimpleNamespace(recordings=(), motions=["swing"]), said.append)  # type: ignore[arg-type]
    assert answer is not None
    assert sorted(text.partition(",")[0] for text in said) == tried
    assert len(simulated) == len(tried)
    assert answer.content["motion"] in tried


def test_no_candidate_is_compared_without_a_motion_to_hold_out(monkeypatch):
    result = make_result([0.0, HIDDEN_A, 0.0, 0.0], ["swing"])

    def forbidden(*_):
        raise AssertionError

    for name in ("_search_stepwise", "_search_from_prior", "_search_heterogeneous"):
        monkeypatch.setattr(search_module, name, forbidden)
    monkeypatch.setattr(search_module, "quadratic_warm_start", lambda model, *_: (model, None))
    monkeypatch.setattr(search_module, "fit", lambda *_, **__: result.start)
    monkeypatch.setattr(search_module, "find_bifurcating_bins", lambda *_: [])
    monkeypatch.setattr(search_module, "find_replicate_pairs", lambda *_: [])
    data = SimpleNamespace(motions=["swing"], recordings=(), episodes=())
    answer = search(result.start.model, data, result.start.linearisation.hypotheses)  # type: ignore[arg-type]
    assert (answer.accepted, answer.total_gain, answer.has_held_out_motions) == ([], None, False)
    assert len(answer.held_out[0].residual) == len(result.start.whitened.value)


def summary(verdict, **content):
    lists = ("causes", "initial_causes", "minor", "ruled_out", "wrong_sign", "undecided", "unresolvable")
    blank = {key: [] for key in (*lists, "lack_of_fit", "force_drifts", "warnings", "in_sample")}
    blank |= dict.fromkeys(("gain", "missing_force", "residual_force", "next_experiment"))
    return write_sentences(verdict, blank | {"also_unexplained": False, "single_motion": True} | content)


def test_one_motion_is_said_to_confirm_nothing():
    drag = {"effect": "air.drag_n", "amplitude": 1.56, "unit": "-", "expected_gain": 94.0, "explains_as_well": True}
    linear = drag | {"effect": "air.linear", "amplitude": 2.5, "unit": "1/s"}
    said = summary("inconclusive", in_sample=[drag, linear, linear | {"effect": "mass.hem", "explains_as_well": False}])
    assert said[:2] == [
        VERDICTS["inconclusive"],
        "One motion cannot confirm a cause, because no other one was held out to predict.",
    ]
    text = " ".join(said)
    assert "Fits best in sample: air.drag_n = 1.56" in text
    assert "about equally well by air.linear = 2.5 1/s." in text
    assert "In part by mass.hem" in text
    assert "for this motion only" in " ".join(summary("adequate"))
    assert "this motion only" not in " ".join(summary("adequate", single_motion=False))
    assert "another motion" in describe_next_step("adequate", {"single_motion": True})


@pytest.mark.slow
def test_drag_in_one_motion_is_ranked_first_and_not_named():
    first = sheet_episodes.make_episode()
    asked = [
        h
        for h in list_hypotheses(build_base_model(first), [first])
        if h.name in ("air.drag_n", "mass.hem", "obs.extrinsic[y]")
    ]
    (drag,) = (h for h in asked if h.name == "air.drag_n")
    recordings = [sheet_episodes.record_changed_world("fast", lambda world: drag.apply(world, 1.5), 1)]
    answer = diagnose(recordings, hypotheses=asked)
    assert (answer.verdict, answer.content["causes"], answer.content["residual_force"]) == ("inconclusive", [], None)
    best = answer.content["in_sample"][0]
    assert (best["effect"], best["amplitude"]) == ("air.drag_n", pytest.approx(1.5, rel=0.2))
    assert answer.content["next_experiment"]["motion"]
    assert answer.experiment is not None
