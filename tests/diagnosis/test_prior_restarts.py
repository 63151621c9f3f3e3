"""Restarts: a parameter far from its data sheet is fitted again from there, with the causes known by then."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import pytest
import torch
from helpers import linear_evidence as toys

from torchcloth.diagnosis.data.dataset import DiagnosisData
from torchcloth.diagnosis.decide import candidates, gates, search
from torchcloth.diagnosis.decide.candidates import AcceptedCause
from torchcloth.diagnosis.decide.criteria import CRITERIA, RestartCriteria
from torchcloth.diagnosis.decide.gates import Candidate
from torchcloth.diagnosis.inference import prior_restarts
from torchcloth.diagnosis.inference.prior_restarts import refit_from_prior
from torchcloth.episodes.world import STRAINED_PRIOR_STDS
from torchcloth.errors import SimulationDiverged

CAUSE = toys.make_hypothesis("cause", 2.0)


def found(far: float):
    """A fit with one cause whose first number is ``far`` prior standard deviations from its data sheet."""
    there = toys.make_model_fit(
        toys.draw_linearisation(toys.draw_jacobian(1, 2), 1, [], torch.tensor([0.4]).double(), 0), std=0.5
    )
    model = there.model.with_hypothesis(CAUSE, 1.5).at_point(torch.tensor([0.5 * far, 1.5]).double())
    return replace(there, model=model)


def test_a_number_is_strained_beyond_what_data_sheets_are_wrong_by():
    ((p, far),) = found(STRAINED_PRIOR_STDS + 0.2).model.strained_parameters
    assert p.name == "p0"
    assert far == pytest.approx(STRAINED_PRIOR_STDS + 0.2)
    assert found(STRAINED_PRIOR_STDS - 0.1).model.strained_parameters == []


@pytest.mark.parametrize("ends", [0.3, STRAINED_PRIOR_STDS + 1])
def test_it_begins_at_the_data_sheet_and_is_nothing_where_that_ends_as_far(monkeypatch, ends):
    begun, asked = [], []

    def fit(model, setting, hypotheses=(), *_, **__):
        asked.append(list(hypotheses))
        return found(ends)

    monkeypatch.setattr(
        prior_restarts, "quadratic_warm_start", lambda model, setting, progress: (begun.append(model) or model, None)
    )
    monkeypatch.setattr(prior_restarts, "fit", fit)
    again = refit_from_prior(found(STRAINED_PRIOR_STDS + 1), None, [CAUSE])  # type: ignore[arg-type]
    assert begun[0].point.tolist() == [0.0, 1.5]
    assert (again is None) == (ends > STRAINED_PRIOR_STDS)
    assert len(asked) == (1 if again is None else 2)  # what is not kept is asked about no others
    assert asked[0] == []


def test_causes_that_are_known_stay_where_others_are_tried_from_the_data_sheet(monkeypatch):
    asked = []

    def gather(model, *_):
        asked.append(model)
        raise SimulationDiverged("x", got="nan", expected="numbers")

    monkeypatch.setattr(prior_restarts, "linearise", gather)
    with pytest.raises(SimulationDiverged):
        prior_restarts.propose_from_prior(found(STRAINED_PRIOR_STDS + 1), None, [], 4)  # type: ignore[arg-type]
    assert asked[0].point.tolist() == [0.0, 1.5]


def test_where_the_data_sheet_is_no_world_nothing_begins_there(monkeypatch):
    def diverges(*_):
        raise SimulationDiverged("x", got="nan", expected="numbers")

    monkeypatch.setattr(prior_restarts, "quadratic_warm_start", diverges)
    assert refit_from_prior(found(STRAINED_PRIOR_STDS + 1), None, [CAUSE]) is None  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("after", "explained", "pulls", "lacking", "relieves", "kept"),
    [
        (0.9e-3, 0.5, 0.0, False, False, True),
        (1.1e-3, 0.5, 0.0, False, False, False),
        (1.1e-3, 0.06, 0.0, False, True, False),
        (0.9e-3, 0.06, 0.0, False, True, True),  # a number of the fabric has done it until then
        (0.9e-3, 0.06, 0.0, False, False, False),  # friction for a stiff patch (sealed 016): 6 %, and 74 in log density
        (0.9e-3, 0.06, 6e-3, False, False, True),  # pulls tell of it
        (0.9e-3, 0.06, 0.0, True, False, True),  # of all that is lacking, a share that is judged otherwise
    ],
)
def test_causes_with_which_positions_are_hardly_better_predicted_are_none(
    monkeypatch, after, explained, pulls, lacking, relieves, kept
):
    """Though each did better when it was accepted, with the noise of then."""
    one = found(0.1)
    whole = SimpleNamespace(rms_before=1e-3, rms_after=after, explained_fraction=explained, rms_removed=(4e-4, pulls))
    row = SimpleNamespace(hypothesis=CAUSE)
    first = AcceptedCause(
        Candidate(row, one, None, None, set(), 0.0, restores_prior=relieves), None, [], [], [], one, None
    )  # type: ignore[arg-type]
    monkeypatch.setattr(search, "fit", lambda *_, **__: one)
    monkeypatch.setattr(search, "screen", lambda f: [])
    monkeypatch.setattr(search, "evaluate_candidates", lambda *_: None)
    monkeypatch.setattr(search, "drop_redundant", lambda current, steps, *_: (current, steps))
    monkeypatch.setattr(search, "fraction_explained", lambda *_: 1.0)
    monkeypatch.setattr(search, "has_lack_of_fit", lambda *_: lacking)
    monkeypatch.setattr(search, "_drop_new_bifurcations", lambda start, current, setting, _: (start, current, setting))
    monkeypatch.setattr(search, "_compute_total_gain", lambda *_: whole)
    _, steps, _ = search._search_stepwise(one, SimpleNamespace(motions=["a"]), [CAUSE], lambda _: None, 4, first)  # type: ignore[arg-type]
    assert steps == ([first] if kept else [])


def explain_everything(monkeypatch):
    """Let all causes together pass the last gate."""
    monkeypatch.setattr(search, "fraction_explained", lambda *_: 1.0)
    monkeypatch.setattr(search, "has_lack_of_fit", lambda *_: False)
    monkeypatch.setattr(
        search,
        "_compute_total_gain",
        lambda *_: SimpleNamespace(rms_before=1.0, rms_after=0.5, explained_fraction=0.75),
    )


@pytest.mark.parametrize("better", [True, False])
def test_the_next_cause_is_looked_for_from_both_or_from_the_better_one(monkeypatch, better):
    """The first step ends strained; the second sees the causes of both fits, or those of the new one alone."""
    strained, anew = found(STRAINED_PRIOR_STDS + 1), found(0.2)
    looked, row = [], SimpleNamespace(hypothesis=CAUSE)
    first = AcceptedCause(Candidate(row, strained, None, None, set(), 0.0), None, [], [], [], strained, None)  # type: ignore[arg-type]
    monkeypatch.setattr(search, "refit_from_prior", lambda *_: anew)
    monkeypatch.setattr(search, "fit", lambda *_, **__: strained)
    monkeypatch.setattr(search, "predictive_gain", lambda *_: 1.0 if better else -1.0)
    monkeypatch.setattr(search, "screen", lambda f: [f])
    monkeypatch.setattr(search, "propose_candidates", lambda f, scores, count, skip=0: [(row, f.model)])
    monkeypatch.setattr(
        search, "evaluate_candidates", lambda current, setting, begun, *_: looked.append((current, begun))
    )
    monkeypatch.setattr(search, "drop_redundant", lambda current, steps, *_: (current, steps))
    explain_everything(monkeypatch)
    end, _, _ = search._search_stepwise(strained, SimpleNamespace(motions=["a"]), [CAUSE], lambda _: None, 4, first)  # type: ignore[arg-type]
    ((current, begun),) = looked
    assert current is end is (anew if better else strained)
    assert [model for _, model in begun] == ([anew.model] if better else [strained.model, anew.model])


@pytest.mark.parametrize("ahead", [0.0, CRITERIA.search.min_refit_gain + 1])
def test_causes_are_doubted_again_where_all_are_fitted_on(monkeypatch, ahead):
    """A fit that still has far to go may take back what a cause was accepted for."""
    far, near = replace(found(0.1), expected_gain=ahead), found(0.1)
    row = SimpleNamespace(hypothesis=CAUSE)
    first = AcceptedCause(Candidate(row, far, None, None, set(), 0.0), None, [], [], [], far, None)  # type: ignore[arg-type]
    doubted, fits = [], iter([far, far, near, near])  # fitted, then asked about the other causes
    monkeypatch.setattr(search, "fit", lambda *_, **__: next(fits))
    monkeypatch.setattr(search, "screen", lambda f: [])
    monkeypatch.setattr(search, "propose_candidates", lambda *_, **__: [])
    monkeypatch.setattr(search, "evaluate_candidates", lambda *_: None)
    monkeypatch.setattr(
        search, "drop_redundant", lambda current, steps, *_: (doubted.append(current) or current, steps)
    )
    explain_everything(monkeypatch)
    end, _, _ = search._search_stepwise(far, SimpleNamespace(motions=["a"]), [CAUSE], lambda _: None, 4, first)  # type: ignore[arg-type]
    assert doubted == ([far, near] if ahead else [far])
    assert end is doubted[-1]


@pytest.mark.parametrize(
    ("motions", "lacking", "surely", "named"),
    [
        ("abc", True, 1.0, True),
        ("abc", False, 1.0, False),
        ("abc", False, 7.0, False),
        ("abc", False, 9.0, True),
        ("aab", False, 9.0, False),
    ],
)
def test_where_nothing_is_lacking_a_cause_from_the_data_sheet_must_surely_gain(
    monkeypatch, motions, lacking, surely, named
):
    """The fit has made up for half an effect, and nulls' causes promise something as well."""
    start, tried = found(0.1), []
    gain = SimpleNamespace(lower_bound_95=surely)
    first = AcceptedCause(Candidate(None, start, None, gain, set(), 0.0), None, [], [], [], start, None)  # type: ignore[arg-type]
    monkeypatch.setattr(search, "has_lack_of_fit", lambda *_: lacking)
    monkeypatch.setattr(search, "screen", lambda f: [])
    monkeypatch.setattr(search, "propose_from_prior", lambda *a: tried.append(a[-1]) or [])
    monkeypatch.setattr(search, "evaluate_candidates", lambda *_: first)
    monkeypatch.setattr(search, "_search_stepwise", lambda *a: (start, [a[-1]], None))
    _, steps, _ = search._search_from_prior(start, SimpleNamespace(motions=[*motions]), [CAUSE], lambda _: None)  # type: ignore[arg-type]
    assert steps == ([first] if named else [])
    assert tried == ([] if motions == "aab" else [0.0 if lacking else CRITERIA.screening.min_expected_gain])


@pytest.mark.parametrize(("least", "tried"), [(0.0, ["much", "half"]), (5.0, ["much"]), (20.0, [])])
def test_little_is_not_tried_from_the_data_sheet(monkeypatch, least, tried):
    promised = [(10.0, "much", None), (5.0, "half", None), (1.0, "little", None)]
    causes = [toys.make_hypothesis(name, 2.0) for _, name, _ in promised]
    monkeypatch.setattr(prior_restarts, "linearise", lambda *_: found(0.0).linearisation)
    monkeypatch.setattr(prior_restarts, "linearise_hypotheses", lambda here, *_: here)
    monkeypatch.setattr(prior_restarts, "_expected_gains", lambda _: promised)
    monkeypatch.setattr(prior_restarts, "CRITERIA", replace(CRITERIA, restart=RestartCriteria(0.4)))
    monkeypatch.setattr(prior_restarts, "add_cause", lambda _, h: h)
    begun = prior_restarts.propose_from_prior(found(0.0), None, causes, 4, lambda _: None, least)  # type: ignore[arg-type]
    assert [h.name for h, _ in begun] == tried


@pytest.mark.parametrize(
    ("motions", "alone", "surely", "useful"),
    [
        (["fold", "hang", "swing"], set(), 1.0, True),
        (["fold", "hang", "swing"], {"fold"}, 7.0, False),
        (["fold", "hang", "swing"], {"fold"}, 9.0, True),
        (["fold", "hang"], {"fold"}, 24.0, False),
        (["fold", "hang"], {"fold"}, 26.0, True),
    ],
)
def test_what_one_motion_alone_tells_must_surely_gain(monkeypatch, motions, alone, surely, useful):
    """No other motion has predicted it; of two, the other one tells little of what is usual."""
    monkeypatch.setattr(gates, "is_improvement", lambda *_: True)
    fit = found(0.1)
    monkeypatch.setattr(gates, "jackknife", lambda *_: (fit.model.point, torch.zeros(2)))
    gain, score = SimpleNamespace(lower_bound_95=surely), SimpleNamespace(hypothesis=CAUSE, mesh_bias=0.0)
    predicted = SimpleNamespace(episode=torch.arange(len(motions)))
    tried = Candidate(score, fit, predicted, gain, alone, 2.0)  # type: ignore[arg-type]
    assert gates.accept(tried, motions) == useful
    assert gates.accept(tried, [*motions, "one whose bins all respond discontinuously"]) == useful


@pytest.mark.parametrize(("amplitude", "tries"), [(1.0, ["first"]), (11.0, ["first", "more"])])
def test_where_what_predicts_best_is_too_large_to_be_believed_more_are_tried(monkeypatch, amplitude, tries):
    """Gravity that leans by 70 mrad stood for wind, which was not among the four."""
    tried = []

    class Enough(Exception):
        pass

    def likely(current, setting, begun, progress):
        tried.append(begun)
        gain = SimpleNamespace(log_density=50.0)
        return [SimpleNamespace(hypothesis=CAUSE, amplitude=amplitude, gain=gain, score=None, fit=found(0.1))]

    def enough(_):
        raise Enough

    monkeypatch.setattr(candidates, "_fit_candidates", likely)
    monkeypatch.setattr(candidates, "fit_noise", enough)
    with pytest.raises(Enough):
        candidates.evaluate_candidates(found(0.1), None, "first", [], print, "more")  # type: ignore[arg-type]
    assert tried == tries


@pytest.mark.parametrize(
    ("first", "then", "predicts", "kept"),
    [(1.0, 2.0, 30.0, "first"), (1.0, 2.0, 45.0, "then"), (0.0, 2.0, 30.0, "then"), (0.0, 0.0, 30.0, "first")],
)
def test_further_steps_are_kept_unless_they_predict_worse_than_a_cause(first, then, predicts, kept):
    """A loose grip that ended at nothing predicted by its slopes alone, 48 against 36."""
    fits = {
        name: SimpleNamespace(name=name, amplitude=amplitude, gain=SimpleNamespace(log_density=density))
        for name, amplitude, density in (("first", first, 50.0), ("then", then, predicts))
    }
    assert candidates._choose_fit(*fits.values()).name == kept  # type: ignore[arg-type]


def test_what_a_model_has_is_not_asked_about_again(monkeypatch):
    """Also where somebody names what is to be asked about."""
    asked = []

    class Enough(Exception):
        pass

    def base_fit(model, setting, hypotheses, **_):
        asked.extend(h.name for h in hypotheses)
        raise Enough

    monkeypatch.setattr(search, "quadratic_warm_start", lambda model, *_: (model, None))
    monkeypatch.setattr(search, "fit", base_fit)
    model = toys.make_model_fit(
        toys.draw_linearisation(toys.draw_jacobian(1, 2), 1, [], torch.tensor([0.4]).double(), 0)
    ).model
    other = toys.make_hypothesis("another")
    with pytest.raises(Enough):
        search.search(model.with_hypothesis(CAUSE, 1.0), None, [CAUSE, other])  # type: ignore[arg-type]
    assert asked == ["another"]


@dataclass(frozen=True)
class Asked:
    """Of a setting, what a chain of causes needs."""

    motions: list[str]
    bifurcating_bins: tuple[torch.Tensor, ...]
    without_bins = DiagnosisData.without_bins


@pytest.mark.parametrize(
    ("lacking", "kept", "left_out"),
    [({1}, True, 2), ({1}, False, 1), ({1, 2}, True, 1), (set(), True, 1)],  # lacking with so many cells left out
)
def test_cells_that_jump_with_a_cause_are_left_out_where_nothing_else_is_lacking(monkeypatch, lacking, kept, left_out):
    """A loose grip leaves slack that buckles to either side, where vacuum has none."""
    whole = toys.make_model_fit(
        toys.draw_linearisation(toys.draw_jacobian(4, 2), 1, [], torch.tensor([0.4]).double(), 0)
    )
    first, second = (tuple(c.key[k : k + 1] for c in whole.linearisation.bins) for k in (0, 1))
    start = search.drop_bins(whole, first)
    best = Candidate(SimpleNamespace(hypothesis=CAUSE), start, None, None, set(), 0.0)  # type: ignore[arg-type]
    step = AcceptedCause(best, None, [], [], [], start, None)  # type: ignore[arg-type]
    monkeypatch.setattr(
        search, "fit", lambda model, setting, *_, **__: search.drop_bins(whole, setting.bifurcating_bins)
    )
    monkeypatch.setattr(search, "find_bifurcating_bins", lambda *_: second)
    less = lambda f: len(whole.linearisation.bins[0].key) - len(f.linearisation.bins[0].key)  # noqa: E731
    monkeypatch.setattr(search, "has_lack_of_fit", lambda f, _: less(f) in lacking)
    monkeypatch.setattr(search, "screen", lambda f: [])
    monkeypatch.setattr(search, "evaluate_candidates", lambda *_: None)
    monkeypatch.setattr(search, "drop_redundant", lambda current, steps, *_: (current, steps))
    monkeypatch.setattr(search, "fraction_explained", lambda *_: float(kept))
    monkeypatch.setattr(
        search,
        "_compute_total_gain",
        lambda *_: SimpleNamespace(rms_before=1.0, rms_after=0.5, explained_fraction=0.75),
    )
    asked = Asked(["a"] * toys.EPISODE_COUNT, first)
    found = search._search_stepwise(start, asked, [], lambda _: None, 4, step)  # type: ignore[arg-type]
    assert found.accepted == ([step] if kept else [])
    for cells, keys, before in zip(
        found.fit.linearisation.bins, found.data.bifurcating_bins, whole.linearisation.bins, strict=True
    ):
        assert len(keys) == left_out
        assert torch.equal(cells.key, before.key[left_out:])
