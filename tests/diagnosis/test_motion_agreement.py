"""How far motions must agree about a cause."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from helpers import linear_evidence as toys
from scipy.stats import t

from torchcloth._utils.constants import Z_95
from torchcloth.diagnosis.decide.candidates import _find_worsened_motions, _measure_prior_shift, _rank
from torchcloth.diagnosis.decide.criteria import CRITERIA
from torchcloth.diagnosis.decide.gates import Candidate, accept, choose_t_threshold
from torchcloth.diagnosis.decide.verdict import _amplitude_errors, _describe_parameters, _do_motions_disagree
from torchcloth.diagnosis.inference.comparison import (
    Gain,
    count_effective_motions,
    jackknife,
    list_observed_motions,
    predict_held_out,
)
from torchcloth.diagnosis.inference.screening import ScoreTest
from torchcloth.episodes.world import WorldModel


def gain(after):
    return Gain(1.0, after, 50.0, (10.0, 90.0), 0.5, (0.2, 0.8), (1.0, after), (0.0, 0.0), 20.0)


@pytest.mark.parametrize(
    ("after", "names", "first", "asked"),
    [
        (0.7, ["a", "b", "c"], True, Z_95),  # half of the mean square
        (0.9, ["a", "b", "c"], True, 4.30),  # a fifth
        (0.7, ["a", "b", "c"], False, 8.86),  # beside another cause, the best of four
        (0.7, ["a", "b", "b"], True, 12.71),  # two motions
        (1.2, ["a", "b", "c", "d"], True, 3.18),
    ],
)
def test_what_mends_much_of_all_that_is_wrong_may_differ_from_motion_to_motion(after, names, first, asked):
    assert choose_t_threshold(gain(after), names, set(), first) == pytest.approx(asked, abs=0.01)


def test_a_motion_that_alone_tells_counts_twice_and_does_not_make_three():
    assert choose_t_threshold(gain(0.7), ["a", "b"], {"a"}, True) == pytest.approx(4.30, abs=0.01)


def test_motions_without_cells_neither_count_nor_are_left_out():
    """All of them jump: three motions of which one is silent are two."""
    slopes = toys.draw_jacobian(2, 3)
    ev = toys.draw_linearisation(slopes, 2, [], torch.tensor([0.3, -0.2]).double(), 0)
    silent = replace(
        ev,
        bins=[*ev.bins[:3], ev.bins[3].select(slice(0))],
        mesh_differences=[*ev.mesh_differences[:3], ev.mesh_differences[3][:0]],
    )
    three = replace(ev, bins=ev.bins[:3], nuisance_stds=ev.nuisance_stds[:3], mesh_differences=ev.mesh_differences[:3])
    mean, std = jackknife(toys.make_model_fit(silent), ["a", "b", "c", "d"])
    for one, other in zip((mean, std), jackknife(toys.make_model_fit(three), ["a", "b", "c"]), strict=True):
        torch.testing.assert_close(one, other)
    assert list_observed_motions(toys.make_model_fit(silent).whitened.episode, ["a", "b", "c", "d"]) == ["a", "b", "c"]


def test_one_motion_agrees_with_nothing():
    assert choose_t_threshold(gain(0.7), ["a"], set(), True) == float("inf")


def test_the_numbers_are_those_of_students_distribution():
    for k, (single, of_best) in enumerate(
        zip(CRITERIA.candidate.t_quantiles, CRITERIA.candidate.t_quantiles_best_of_four, strict=True), 1
    ):
        assert single == pytest.approx(t.ppf(0.975, k), abs=0.006)
        assert of_best == pytest.approx(t.ppf(1 - 0.025 / CRITERIA.candidate.max_tried, k), abs=0.006)


def test_of_those_that_predict_alike_the_one_that_mends_most_comes_first():
    tried = [
        Candidate(None, None, None, gain(after)._replace(log_density=density), set(), 2.57)  # type: ignore[arg-type]
        for after, density in ((0.5, 100.0), (0.3, 97.0), (0.1, 95.0), (0.4, 98.0))
    ]
    assert [c.gain.log_density for c in _rank(tried)] == [97.0, 98.0, 100.0, 95.0]
    assert _rank([]) == []


def is_agreed(tried, fit=None, role="accepted"):
    """Whether motions agree about a candidate that surely improves all predictions."""
    sure_gain = Gain(1.0, 0.5, 50.0, (10.0, 90.0), 0.5, (0.2, 0.8), (1.0, 0.5), (1e-2, 0.0), 20.0)
    return accept(tried, list("abcd"), fit, sure_gain, role)


@pytest.mark.parametrize(("asked", "agreed"), [(0.1, True), (-0.5, False)])
def test_motions_that_all_take_a_cause_away_do_not_agree_that_it_is_there(asked, agreed):
    """At zero, where an amplitude without a sign ends, they differ by nothing at all."""
    tried = candidate(asked, 0.0)
    assert is_agreed(tried) == agreed


@pytest.mark.parametrize(("numerics", "agreed"), [(0.02, True), (-0.02, True), (0.5, False), (-0.5, False)])
def test_what_another_mesh_would_ask_for_is_no_cause(numerics, agreed):
    """Motions agree about what the same mesh does to all of them."""
    tried = candidate(0.1, numerics)
    assert is_agreed(tried) == agreed


def test_less_is_asked_of_a_rival_than_of_a_cause():
    """Ten standard errors of the thirteen that three motions ask for, one of which tells alone, rule nothing out."""
    tried = candidate(0.1, 0.0)
    cells = tried.fit.linearisation.bins
    for k, c in enumerate(cells):  # each asks for a little more or less
        cells[k] = c._replace(value=c.value - (0.03, -0.03, 0.02, -0.02)[k] * c.jacobian[:, 1])
    tried = replace(tried, fit=toys.make_model_fit(tried.fit.linearisation), t_threshold=1e3)
    model = replace(tried.fit.model, accepted=(tried.hypothesis,), amplitudes=(0.3,))
    model = replace(model, parameters=model.parameters[:1], coordinates=torch.zeros(1).double())
    tried = replace(tried, fit=replace(tried.fit, model=model))
    assert not is_agreed(tried)
    assert is_agreed(tried, role="rival")
    assert not is_agreed(replace(tried, score=tried.score._replace(mesh_bias=5.0)), role="rival")


@pytest.mark.parametrize(("amplitude", "named", "rival"), [(4.9, True, True), (5.1, False, True), (10.1, False, False)])
def test_a_rival_may_be_larger_than_a_cause(amplitude, named, rival):
    """A lean of 0.0501 rad, a hair more than is believed, left a wind alone that it cannot be told from."""
    tried = candidate(0.1, 0.0)
    model = replace(tried.fit.model, amplitudes=(amplitude,))
    tried = replace(tried, fit=replace(tried.fit, model=model))
    assert is_agreed(tried) == named
    assert is_agreed(tried, role="rival") == rival


@pytest.mark.parametrize(("alone", "least", "named"), [({"a"}, 30.0, True), ({"a"}, 20.0, False), (set(), 30.0, False)])
def test_halves_of_one_motion_need_not_agree_about_the_size_of_what_is_overwhelming(alone, least, named):
    """Creases of 5 1/s in one fold: 43 in log density, 0.4 standard errors by slopes of what has levelled off.

    They leave other motions alone; friction in the place of a stiff patch (sealed 016) took a turn by a third worse.
    """
    tried = replace(
        candidate(0.1, 0.0),
        sole_informative_motion=alone,
        gain=gain(0.7)._replace(lower_bound_95=least),
        t_threshold=1e3,
    )
    cells = tried.fit.linearisation.bins
    for k, c in enumerate(cells):
        cells[k] = c._replace(value=c.value - (0.03, -0.03, 0.02, -0.02)[k] * c.jacobian[:, 1])
    model = tried.fit.model
    tried = replace(tried, fit=replace(toys.make_model_fit(tried.fit.linearisation), model=model))
    assert is_agreed(tried) == named
    assert not is_agreed(replace(tried, worsens_another_motion=True))
    nothing = replace(model, amplitudes=(0.0,))
    assert not is_agreed(tried, replace(tried.fit, model=nothing))


def test_what_one_motion_tells_is_not_there_where_another_becomes_less_likely():
    """Friction in bending for a stretch that folds another way: it gained 186, and a turn lost 30 (0.76 to 1.26 mm)."""
    tried = replace(candidate(0.1, 0.0), sole_informative_motion={"a"}, gain=gain(0.7))
    assert is_agreed(replace(tried, worsens_another_motion=True))
    assert not is_agreed(replace(tried, worsens_another_motion=True, is_contradicted=True))
    assert is_agreed(replace(tried, is_contradicted=True, prior_shift=5.1))


def test_a_motion_that_is_predicted_worse_is_found_where_it_is_not_the_one_that_tells():
    ev = toys.draw_linearisation(toys.draw_jacobian(1, 3), 2, [], torch.tensor([0.0, 0.1]).double(), 0)
    first = predict_held_out(toys.make_model_fit(ev), list("abcd"))
    larger = torch.ones(4).double().index_fill(0, torch.tensor([1]), 1.5)[first.episode]
    second = first._replace(residual=larger * first.residual, whitened=larger * first.whitened)
    (worse,) = _find_worsened_motions(first, second, list("abcd"), {"a"})
    assert worse.rms_after == pytest.approx(1.5 * worse.rms_before)
    assert worse.log_density < 0
    assert _find_worsened_motions(first, second, list("abcd"), {"b"}) == []


def test_motions_need_not_agree_about_a_number_that_nothing_else_has_bent_so_far():
    """Stiffening, 6.6 prior standard deviations from its sheet: a stretch tells of it, and a drag says otherwise."""
    tried = replace(candidate(0.1, 0.0), t_threshold=1e3)
    cells = tried.fit.linearisation.bins
    for k, c in enumerate(cells):
        cells[k] = c._replace(value=c.value - (0.3, -0.3, 0.2, -0.2)[k] * c.jacobian[:, 1])
    tried = replace(tried, fit=replace(toys.make_model_fit(tried.fit.linearisation), model=tried.fit.model))
    assert not is_agreed(tried)
    assert not is_agreed(replace(tried, prior_shift=4.9))
    assert is_agreed(replace(tried, prior_shift=5.1))


def test_how_far_a_twin_has_left_its_sheet_is_in_standard_deviations_of_its_prior():
    model = WorldModel(None, (toys.make_parameter("p", 0.5), toys.make_parameter("q", 2.0)), torch.tensor([-3.0, 5.0]))  # type: ignore[arg-type]
    assert _measure_prior_shift(model, "p") == 6.0
    assert _measure_prior_shift(model, "q") == 2.5
    assert _measure_prior_shift(model, "") == 0.0


def test_as_many_tell_as_would_say_as_much():
    slopes = toys.draw_jacobian(1, 3)
    all_alike = slopes[:1].expand(4, -1, -1).clone()
    one = all_alike.clone()
    one[1:, :, 1] = 0.0
    told = [
        count_effective_motions(
            toys.make_model_fit(toys.draw_linearisation(own, 2, [], torch.zeros(2).double(), 0)),
            1,
            list("abcd"),
            halved,
        )
        for own, halved in ((all_alike, ()), (one, ()), (one, {"a"}))
    ]
    assert told[0] == pytest.approx(4.0, abs=1e-6)
    assert 1.0 < told[1] < 1.5  # the others tell of the first number, which it is told beside
    assert told[1] + 0.3 < told[2] < 3.0


def candidate(asked, numerics):
    """A cause in the model of four motions that ask for so much of it, of which numerics alone would ask for a part."""
    ev = toys.draw_linearisation(toys.draw_jacobian(1, 3), 2, [], torch.tensor([0.0, asked]).double(), 0)
    there = toys.make_model_fit(ev)
    cause = replace(toys.make_hypothesis("cause"), signed=False)
    model = WorldModel(None, there.model.parameters[:1], torch.zeros(1).double(), (cause,), (0.3,))  # type: ignore[arg-type]
    row = ScoreTest(cause, asked, 0.01, numerics, 0.0, 0.0, 0.0, asked, 0.0, "present")
    return Candidate(row, replace(there, model=model), None, None, set(), 2.57)  # type: ignore[arg-type]


def test_a_numbers_interval_knows_of_what_motions_disagree_by():
    """Each of four motions has a value of its own: one interval holds what noise allows, the other what they say."""
    ev = toys.draw_linearisation(toys.draw_jacobian(1, 3), 2, [], torch.zeros(2).double(), 0)
    own = (0.3, -0.3, 0.2, -0.2)
    cells = [c._replace(value=c.value - a * c.jacobian[:, 1]) for c, a in zip(ev.bins, own, strict=True)]
    found = toys.make_model_fit(replace(ev, bins=cells))
    width = {
        name: (row["ci95"][1] - row["ci95"][0]) / 3.92
        for name, row in _describe_parameters(SimpleNamespace(end=found), list("abcd")).items()  # type: ignore[arg-type]
    }
    noise, motions = found.covariance.diagonal().sqrt(), jackknife(found, list("abcd"))[1]
    student, values = float(motions[1]) * 3.18 / 1.96, found.model.coordinates.tolist()  # of four
    assert width["p1"] == pytest.approx(math.hypot(student, 0.03 * values[1]))
    assert width["p1"] > 3 * float(noise[1])
    assert all(width[f"p{k}"] >= float(noise[k]) - 1e-12 for k in range(2))


@pytest.mark.parametrize(
    ("own", "told", "disagree"),
    [((0.0,) * 4, 4.0, False), ((0.3, -0.3, 0.2, -0.2), 4.0, True), ((0.3, -0.3, 0.2, -0.2), 1.9, False)],
)
def test_motions_that_differ_by_more_than_noise_disagree(own, told, disagree):
    """Where hardly two of them tell of a number, nothing is known of what others would say."""
    ev = toys.draw_linearisation(toys.draw_jacobian(1, 3), 2, [], torch.zeros(2).double(), 1)
    cells = [c._replace(value=c.value - a * c.jacobian[:, 1]) for c, a in zip(ev.bins, own, strict=True)]
    found = SimpleNamespace(end=toys.make_model_fit(replace(ev, bins=cells)))
    assert _do_motions_disagree(found, 1, told, list("abcd")) == disagree  # type: ignore[arg-type]


@pytest.mark.slow
def test_motions_of_one_value_disagree_as_often_as_chance_has_it():
    slopes, count = toys.draw_jacobian(1, 3), 300
    found = [
        toys.make_model_fit(toys.draw_linearisation(slopes, 2, [], torch.zeros(2).double(), seed))
        for seed in range(count)
    ]
    told = count_effective_motions(found[0], 1, list("abcd"))
    often = sum(_do_motions_disagree(SimpleNamespace(end=f), 1, told, list("abcd")) for f in found)  # type: ignore[arg-type]
    assert often <= 0.02 * count


def test_an_error_is_the_noises_where_motions_agree_and_says_how_many_tell():
    ev = toys.draw_linearisation(toys.draw_jacobian(1, 3), 2, [], torch.zeros(2).double(), 0)
    share = (1.0, 1.0, 0.0, 0.0)  # two of four motions tell of the second number, all of the first
    scale = lambda c, s: torch.stack([c.jacobian[:, 0], s * c.jacobian[:, 1]], 1)  # noqa: E731
    cells = [c._replace(jacobian=scale(c, s), value=0 * c.value) for c, s in zip(ev.bins, share, strict=True)]
    found = toys.make_model_fit(replace(ev, bins=cells))
    noise = found.covariance.diagonal().sqrt()
    for place, few in ((0, False), (1, True)):
        own, both, told = _amplitude_errors(SimpleNamespace(end=found), place, list("abcd"), ())  # type: ignore[arg-type]
        assert own == pytest.approx(float(noise[place]))
        assert both == pytest.approx(own, rel=0.3)
        assert (told < 2.2) == few
