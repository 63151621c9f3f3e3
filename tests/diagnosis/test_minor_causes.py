"""Causes below the smallest effect of interest are not named, but what they may stand for is reported."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
from helpers import linear_evidence as toys

from torchcloth.diagnosis.decide import backward_elimination, candidates, gates, search
from torchcloth.diagnosis.decide.candidates import (
    AcceptedCause,
    _predicts_as_well,
    _predicts_clearly_better,
)
from torchcloth.diagnosis.decide.gates import drop_implied
from torchcloth.diagnosis.decide.search import SearchResult
from torchcloth.diagnosis.decide.verdict import _decide, _describe_minor
from torchcloth.diagnosis.inference.comparison import Gain
from torchcloth.episodes.world import RELEVANT_FRACTION, WorldModel
from torchcloth.errors import SimulationDiverged

SCALE, BIAS = ("obs.depth_scale", 0.015, -0.002), ("obs.depth_bias", 5e-3, -2.5e-3)
SCALE_LARGE, EXTRINSIC = ("obs.depth_scale", 0.015, 0.01), ("obs.extrinsic[x]", 4e-3, 2.5e-3)
HEM = ("mass.hem", 0.02, 0.39 * RELEVANT_FRACTION * 0.02)


def candidate(name, typical, amplitude, **options):
    return SimpleNamespace(hypothesis=toys.make_hypothesis(name, typical, **options), amplitude=amplitude, score=None)


def ended(best, *rivals):
    """A search with one cause and what predicts as well."""
    best, *rivals = (candidate(*one) for one in (best, *rivals))
    step = AcceptedCause(best, None, [best, *rivals], rivals, [], None, None)  # type: ignore[arg-type]
    model = WorldModel(None, (), toys.torch.zeros(0), (best.hypothesis,), (best.amplitude,))  # type: ignore[arg-type]
    return SearchResult(None, SimpleNamespace(model=model), [step], [], None, None, 0.0, 0.0, None, None)  # type: ignore[arg-type]


@pytest.mark.parametrize("order", [(SCALE, BIAS, HEM), (BIAS, SCALE, HEM)])
def test_rivals_that_would_matter_are_said_and_no_others(order):
    """Whichever of them happens to do a little more."""
    found = ended(*order)
    assert (found.causes, found.minor) == ([], found.accepted)
    told = _describe_minor(found, found.accepted[0])
    assert told["effect"] == "obs.depth_scale"
    assert [(r["effect"], r["amplitude"]) for r in told["rivals"]] == [("obs.depth_bias", -2.5e-3)]


def test_what_matters_with_all_its_rivals_is_a_cause():
    found = ended(BIAS, EXTRINSIC)
    assert (found.causes, found.minor) == (found.accepted, [])


@pytest.mark.parametrize(("scale", "named"), [(0.0034, True), (0.0029, False)])
def test_of_two_that_cannot_be_told_apart_one_may_be_somewhat_small(scale, named):
    """Depths off by 5 mm look like 0.34 % at 1.5 m; those off by 0.29 %, which does not matter, like 4.3 mm."""
    alike = [("obs.depth_scale", 0.015, scale), ("obs.depth_bias", 5e-3, 1.45 * scale)]
    for order in (alike, alike[::-1]):
        found = ended(*order)
        assert (found.causes, found.minor) == ((found.accepted, []) if named else ([], found.accepted))


@pytest.mark.parametrize(
    ("kin", "asked", "named"), [((), -0.02, False), ((), -0.05, True), (("contact.mu",), -0.02, True)]
)
def test_what_slopes_cannot_tell_from_a_cause_might_have_to_matter_too(monkeypatch, kin, asked, named):
    """045 of d32337c: 0.024 of friction, which does not matter, looked like 0.41 by direction, which would.

    What is the same by structure has no size of its own.
    """
    found = ended(("contact.aniso", -0.5, 0.41), EXTRINSIC)
    (step,), mu = found.accepted, toys.make_hypothesis("contact.mu", 0.2)
    step.candidate.hypothesis = replace(step.candidate.hypothesis, structurally_equivalent=kin)
    like = SimpleNamespace(hypothesis=mu, amplitude=asked, chi2=1.0)
    monkeypatch.setattr(search, "find_confounded", lambda before, row, amplitude, others: others)
    found = replace(found, accepted=[replace(step, scores=[like])])
    assert (found.causes, found.minor) == ((found.accepted, []) if named else ([], found.accepted))
    if not named:
        told = _describe_minor(found, found.accepted[0])
        assert told["effect"] == "contact.mu"
        assert [r["effect"] for r in told["rivals"]] == ["contact.aniso", "obs.extrinsic[x]"]


def test_a_rival_that_joins_the_model_beside_a_cause_is_none_any_more():
    """Neither could be dropped then: they are two."""
    found = ended(SCALE_LARGE, BIAS, EXTRINSIC)
    other = candidate(*BIAS)
    model = WorldModel(None, (), toys.torch.zeros(0), (*found.end.model.accepted, other.hypothesis), (0.01, BIAS[2]))  # type: ignore[arg-type]
    second = AcceptedCause(other, None, [other], [], [], None, None)  # type: ignore[arg-type]
    both = replace(found, end=SimpleNamespace(model=model), accepted=[*found.accepted, second])  # type: ignore[arg-type]
    assert [h.name for h, _ in found.equivalents(found.accepted[0])] == [
        "obs.depth_scale",
        "obs.depth_bias",
        "obs.extrinsic[x]",
    ]
    assert [h.name for h, _ in both.equivalents(both.accepted[0])] == ["obs.depth_scale", "obs.extrinsic[x]"]


@pytest.mark.parametrize("doubtful", [True, False])
def test_what_may_matter_is_not_called_adequate(doubtful):
    told = _decide(SimpleNamespace(scores=[]), [], is_inadequate=False, meshes_agree=True, is_doubtful=doubtful)
    assert told == ("inconclusive" if doubtful else "adequate")


def test_what_brings_another_along_is_no_rival_of_it_where_nothing_else_is_left():
    drag, wind = candidate("air.drag_n", 1.2, 1.2), candidate("air.wind[y]", 0.3, 0.01, implies="air.drag_n")
    assert not _predicts_as_well(wind, None, drag)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("amplitude", "density", "named"),
    [(0.01, 1472.0, ["air.drag_n"]), (0.2, 1472.0, ["air.drag_n", "air.wind[y]"]), (0.01, 900.0, None)],
)
def test_wind_that_does_not_matter_is_not_named_for_the_drag_that_it_brings(amplitude, density, named):
    """Unless it predicts clearly better all the same."""
    drag, wind = candidate("air.drag_n", 1.2, 1.2), candidate("air.wind[y]", 0.3, amplitude, implies="air.drag_n")
    drag.gain, wind.gain = SimpleNamespace(log_density=density), SimpleNamespace(log_density=1477.0)
    found = [c.hypothesis.name for c in drop_implied([drag, wind])]  # type: ignore[list-item]
    assert found == (named or ["air.drag_n", "air.wind[y]"])
    assert drop_implied([wind]) == [wind]  # type: ignore[list-item]


@pytest.mark.parametrize(
    ("name", "amplitude", "over", "ci95", "open_"),
    [
        ("air.drag_n", 1.4, -80.0, (-120.0, -40.0), True),
        ("air.drag_n", 1.4, -80.0, (-170.0, 10.0), False),  # not surely
        ("air.drag_n", 1.4, -3.0, (-3.5, -2.5), False),  # hardly
        ("air.drag_n", 6.1, -80.0, (-120.0, -40.0), True),  # larger than a cause may be, not than a rival
        ("air.drag_n", 12.1, -80.0, (-120.0, -40.0), False),  # of no size that makes sense
        ("air.linear[x]", 1.4, -80.0, (-120.0, -40.0), False),  # the same along another axis
        ("air.wind[y]", 0.01, -80.0, (-120.0, -40.0), False),  # it stands for what it brought along
    ],
)
def test_what_predicts_better_and_motions_disagree_about_is_a_rival(monkeypatch, name, amplitude, over, ci95, open_):
    brings = "air.drag_n" if name == "air.wind[y]" else ""
    better, best = candidate(name, 1.2, amplitude, implies=brings), candidate("air.linear", 2.0, 1.7)
    better.gain = best.prediction = None
    monkeypatch.setattr(gates, "is_worthwhile", lambda *_: True)
    monkeypatch.setattr(candidates, "compare", lambda *_: SimpleNamespace(log_density=over, log_density_ci95=ci95))
    assert _predicts_clearly_better(better, None, best) == open_  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("left", "over", "passed", "named"),
    [
        (0.01, 0.0, True, "air.drag_n"),
        (0.01, -9.0, True, "air.drag_n"),
        (0.01, 5.0, True, "air.wind[y]"),
        (0.3, 0.0, True, "air.wind[y]"),
        (0.01, 0.0, False, "air.wind[y]"),
    ],
)
def test_what_was_brought_along_takes_the_place_of_what_brought_it(monkeypatch, left, over, passed, named):
    """Where hardly any wind is left, and the drag alone predicts about as well and better than its placebos."""
    drag, wind = candidate("air.drag_n", 1.2, 1.4), candidate("air.wind[y]", 0.3, 0.2, implies="air.drag_n")
    drag.fit, drag.sole_informative_motion = None, set()
    camera = toys.make_hypothesis("obs.extrinsic[y]", 4e-3)
    base = WorldModel(None, (), toys.torch.zeros(0), (camera,), (4e-3,))  # type: ignore[arg-type]
    current = SimpleNamespace(model=base.with_hypothesis(wind.hypothesis, left), linearisation=None)
    step = AcceptedCause(wind, None, [wind, drag], [drag], [], None, None)  # type: ignore[arg-type]
    monkeypatch.setattr(backward_elimination, "remove_cause", lambda found, name: found.model.without_hypothesis(name))
    monkeypatch.setattr(
        backward_elimination,
        "fit",
        lambda model, *_, **__: SimpleNamespace(model=model, noise=None, linearisation=None),
    )
    monkeypatch.setattr(backward_elimination, "reweight_by_noise", lambda found, *_: found)
    monkeypatch.setattr(backward_elimination, "run_permutation_test", lambda *_: SimpleNamespace(is_passed=passed))
    monkeypatch.setattr(backward_elimination, "predictive_gain", lambda *_: over)
    asked = (SimpleNamespace(motions=[]), [camera, wind.hypothesis, drag.hypothesis], lambda _: None)
    end, (then,) = backward_elimination.replace_by_implied(current, [step], *asked)  # type: ignore[arg-type]
    assert then.candidate.hypothesis.name == named
    assert [h.name for h in end.model.accepted] == ["obs.extrinsic[y]", named]
    if named == "air.drag_n":
        assert end.model.amplitudes == (4e-3, 1.2)  # what the wind brings
        assert then.rivals == []
        assert then.permutation_test.is_passed


def test_what_is_there_by_itself_is_not_brought_along_again(monkeypatch):
    drag, wind = candidate("air.drag_n", 1.2, 1.4), candidate("air.wind[y]", 0.3, 0.2, implies="air.drag_n")
    model = WorldModel(None, (), toys.torch.zeros(0), (wind.hypothesis, drag.hypothesis), (0.01, 1.4))  # type: ignore[arg-type]
    steps = [AcceptedCause(c, None, [wind, drag], [], [], None, None) for c in (wind, drag)]  # type: ignore[arg-type]
    monkeypatch.delattr(backward_elimination, "fit")
    current = SimpleNamespace(model=model)
    assert backward_elimination.replace_by_implied(current, steps, None, [], print) == (current, steps)  # type: ignore[arg-type]


def test_what_cannot_be_simulated_without_a_cause_leaves_it_in(monkeypatch):
    """All work up to there would be lost, and a diagnosis that goes on would end there again."""
    drag, law = candidate("air.drag_n", 1.2, 1.4), candidate("b", 1.0, 1.0)
    drag.sole_informative_motion = law.sole_informative_motion = set()
    model = WorldModel(None, (), toys.torch.zeros(0), (drag.hypothesis, law.hypothesis), (1.4, 1.0))  # type: ignore[arg-type]
    steps = [AcceptedCause(c, None, [c], [], [], None, None) for c in (drag, law)]  # type: ignore[arg-type]
    current = SimpleNamespace(model=model, noise=None, linearisation=None)

    def diverges(*_):
        raise SimulationDiverged("no such world")

    monkeypatch.setattr(backward_elimination, "remove_cause", lambda found, name: found.model.without_hypothesis(name))
    monkeypatch.setattr(backward_elimination, "accept", lambda *_, **__: False)
    monkeypatch.setattr(backward_elimination, "fit", diverges)
    asked = (SimpleNamespace(motions=[]), [], lambda _: None)
    assert backward_elimination.drop_redundant(current, steps, *asked) == (current, steps)  # type: ignore[arg-type]


def score_of(is_visible: bool, decision: str = "present", expected_gain: float = 10.0) -> SimpleNamespace:
    """Return what screening said of a cause."""
    return SimpleNamespace(is_visible=is_visible, decision=decision, expected_gain=expected_gain)


@pytest.mark.parametrize(
    ("twin", "row", "low", "worth"),
    [
        ("p", score_of(True), 1.0, True),
        ("p", score_of(True), -1.0, False),
        ("p", score_of(False), 1.0, False),
        ("", score_of(True), 1.0, False),
        ("p", score_of(True, expected_gain=60.0), -1.0, True),
        ("p", score_of(True, "inconclusive", 60.0), -1.0, False),
        ("p", score_of(False, expected_gain=60.0), -1.0, False),
        ("", score_of(True, expected_gain=60.0), -1.0, False),
    ],
)
def test_what_a_parameter_does_already_must_show_beside_its_data_sheet(twin, row, low, worth):
    """It mends nothing beside the parameter that has done it, and hardly predicts better where the sheet is far off."""
    gain = Gain(1e-3, 1e-3, 5.0, (low, 9.0), 0.0, (0.0, 0.0), (1e-3, 1e-3), (0.0, 0.0), low)
    fitted = SimpleNamespace(model=SimpleNamespace(parameters=[toys.make_parameter("p")]))
    c = SimpleNamespace(
        hypothesis=toys.make_hypothesis("m", equivalent_parameter=twin), fit=fitted, score=row, prior_shift=0.0
    )
    assert gates.is_improvement(c, gain) == worth  # type: ignore[arg-type]
    assert not gates.is_worthwhile(gain)
    assert not gates.is_improvement(c, gain._replace(log_density=3.0, lower_bound_95=-2.0))  # type: ignore[arg-type]
    c.prior_shift = 6.6  # of stiffening, 016 of e9945f3: by slopes beside its prior it need not gain so much
    assert gates.is_improvement(c, gain) == (worth or (twin == "p" and row.is_visible))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("low", "after", "worth"), [(9.0, 0.999e-3, True), (7.0, 0.999e-3, False), (9.0, 1.001e-3, False)]
)
def test_what_is_sure_is_not_asked_to_mend_much(low, after, worth):
    """Orthotropy of half its size (050 of b3f2eda) gained 44: most of its millimetres had gone into stiffening."""
    gain = Gain(1e-3, after, 20.0, (low, 30.0), 0.0, (0.0, 0.0), (1e-3, 0.995e-3), (2e-4, 3e-3), low)
    assert gates.is_worthwhile(gain) == worth


@pytest.mark.parametrize(
    ("after", "pull", "worth"), [(0.99e-3, 0.0, True), (1.01e-3, 0.0, False), (1.01e-3, 1e-2, True)]
)
def test_what_leaves_all_positions_together_further_off_mends_none(after, pull, worth):
    """Though it does where nothing else goes on, or in one episode; a pull may be mended without them."""
    gain = Gain(1e-3, after, 18.0, (4.0, 33.0), 0.0, (0.0, 0.0), (0.72e-3, 0.70e-3), (4e-4, pull), 5.0)
    assert gates.is_worthwhile(gain) == worth


def test_what_was_only_felt_has_no_positions():
    nowhere = float("nan")
    gain = Gain(nowhere, nowhere, 18.0, (4.0, 33.0), 0.0, (0.0, 0.0), (0.0, 0.0), (0.0, 1e-2), 5.0)
    assert gates.is_worthwhile(gain)
