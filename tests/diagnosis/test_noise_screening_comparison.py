"""Noise, score tests, confounding and comparison on linear examples, against theory."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import linear_evidence as toys

from torchcloth.diagnosis.confirmation import Confirmation
from torchcloth.diagnosis.data.binning import BLOCK_NAMES as KINDS
from torchcloth.diagnosis.data.binning import FORCE_BLOCK
from torchcloth.diagnosis.decide.criteria import CRITERIA
from torchcloth.diagnosis.inference.comparison import (
    HeldOutPrediction,
    _resample_blocks,
    compare,
    jackknife,
    predict_as_given,
    predict_held_out,
    select_episodes,
)
from torchcloth.diagnosis.inference.confounding import are_fits_confounded, correlate_scores, find_confounded
from torchcloth.diagnosis.inference.fitting import gauss_newton_step, put_on_common_noise, reweight_by_noise
from torchcloth.diagnosis.inference.linearise import use_noise_inputs
from torchcloth.diagnosis.inference.noise import Noise, compute_noise_floor, fit_noise, whiten
from torchcloth.diagnosis.inference.screening import ScoreTest, _decide, screen
from torchcloth.diagnosis.report.wording import _is_implausibly_large, _warn_of_large_amplitude
from torchcloth.errors import InvalidInput

NAMES = ["a", "b", "c"]
SLOPES = toys.draw_jacobian(1, 6)  # two parameters, three hypotheses, one nuisance


def asked(truth, seed=0, slopes=SLOPES, **options):
    return toys.make_model_fit(toys.draw_linearisation(slopes, 2, NAMES, torch.tensor(truth).double(), seed), **options)


def row(found, name):
    return next(r for r in screen(found) if r.hypothesis.name == name)


@pytest.mark.slow
def test_a_planted_amplitude_is_found_within_its_error():
    z = []
    for seed in range(60):
        r = row(asked([0.0, 0.0, 0.0, 0.7, 0.0], seed), "b")
        z.append((r.amplitude - 0.7) / r.std)
    z = torch.tensor(z)
    assert abs(float(z.mean())) < 3 / 60**0.5
    assert 0.75 < float(z.std()) < 1.25


@pytest.mark.parametrize(
    "strength", [pytest.param(0.0, marks=pytest.mark.slow), 2.5, pytest.param(4.0, marks=pytest.mark.slow)]
)
def test_power_is_that_of_the_normal_distribution(strength):
    """Beyond t = 2.5 standard errors lie 1 - Phi(t - strength) of the scores of an effect so many of them large."""
    std, count = row(asked([0.0] * 5), "b").std, 100
    drawn = (row(asked([0.0, 0.0, 0.0, strength * std, 0.0], seed), "b") for seed in range(count))
    hits = sum(r.amplitude / r.std > 2.5 for r in drawn)
    power = 0.5 * math.erfc((2.5 - strength) / 2**0.5)
    assert abs(hits / count - power) < 3 * (power * (1 - power) / count) ** 0.5 + 1 / count


def test_single_stretches_are_surely_no_gain():
    """Of episodes of 0.4 s or less nothing is known of how their stretches scatter."""
    found = asked([0.3, 0.0, 0.0, 0.0, 0.0])
    short = [p._replace(window=0 * p.window) for p in (predict_as_given(found), predict_held_out(found, list("abcd")))]
    assert compare(*short, 0.0).log_density > 0
    assert compare(*short, 0.0).lower_bound_95 == -math.inf
    assert (
        -math.inf
        < compare(predict_as_given(found), predict_held_out(found, list("abcd")), 0.0).lower_bound_95
        < math.inf
    )


def test_without_noise_it_is_exact_and_parameters_do_not_matter():
    """r = -J_j a asks for a; what fitted parameters of any size do is not mistaken for a hypothesis."""
    ev = toys.draw_linearisation(SLOPES, 2, NAMES, torch.zeros(5).double(), 0)
    for shift in (0.0, 0.3):
        truth = torch.tensor([shift, -shift, 0.0, 0.7, 0.0]).double()
        cells = [c._replace(value=-c.jacobian[:, :5] @ truth) for c in ev.bins]
        found = toys.make_model_fit(
            ev.__class__(cells, 2, ev.hypotheses, ev.nuisance_stds, ev.mesh_differences), std=1e6
        )
        fitted_out = {r.hypothesis.name: r for r in screen(found)}
        joint = torch.linalg.lstsq(
            torch.cat([c.jacobian[:, [0, 1, 3]] for c in cells]), torch.cat([c.value for c in cells])[:, None]
        ).solution
        assert float(-joint[2, 0]) == pytest.approx(0.7, rel=1e-9)
        assert fitted_out["b"].amplitude == pytest.approx(0.7, rel=1e-6)


def disagreeing(seed, by):
    """(error of the third parameter's estimate, its spread over motions, its error from noise), truth 0.7 +- ``by``."""
    rng = torch.Generator().manual_seed(seed)
    truths = 0.7 + by * torch.randn(toys.EPISODE_COUNT, generator=rng).double()
    none = torch.zeros(5).double()
    ev = toys.draw_linearisation(SLOPES, 3, NAMES[:2], none, seed)
    cells = [c._replace(value=c.value - t * c.jacobian[:, 2]) for c, t in zip(ev.bins, truths, strict=True)]
    found = toys.make_model_fit(ev.__class__(cells, 3, ev.hypotheses, ev.nuisance_stds, ev.mesh_differences), std=1e6)
    own, value = found.whitened.jacobian[:, :3], found.whitened.value
    estimate = -torch.linalg.lstsq(own, value[:, None]).solution[2, 0]
    motions = [str(k) for k in range(toys.EPISODE_COUNT)]
    return float(estimate) - 0.7, float(jackknife(found, motions)[1][2]), float(found.covariance[2, 2].sqrt())


def test_motions_that_disagree_widen_an_error_and_those_that_agree_do_not():
    alike = [disagreeing(seed, 0.0) for seed in range(20)]
    apart = torch.tensor([disagreeing(seed, 0.3) for seed in range(60)])
    assert sum(s for _, s, _ in alike) == pytest.approx(sum(n for _, _, n in alike), rel=0.35)
    covered = lambda std: float((apart[:, 0].abs() < 1.96 * std).double().mean())  # noqa: E731
    assert covered(apart[:, 2]) < 0.5, "the noise within motions knows nothing of it"
    assert covered(apart[:, 1]) > 0.75, "four motions: 95 % by a normal distribution is too much to ask"


def test_scores_do_not_depend_on_how_parameters_are_written():
    """Another coordinate of the parameters (J_n A, precision to match) leaves every amplitude as it is."""
    mixed = SLOPES.clone()
    mixed[..., :2] = SLOPES[..., :2] @ torch.tensor([[2.0, 1.0], [0.5, -1.0]]).double()
    a, b = (screen(asked([0.0, 0.0, 0.4, 0.0, 0.0], 3, s, std=1e6)) for s in (SLOPES, mixed))
    first, second = ({r.hypothesis.name: (r.amplitude, r.chi2) for r in rows} for rows in (a, b))
    for name in NAMES:
        assert first[name] == pytest.approx(second[name], rel=1e-6)


def test_a_nuisance_of_one_episode_is_no_cause():
    """Three standard deviations of every episode's own nuisance leave all hypotheses below notice."""
    ev = toys.draw_linearisation(SLOPES, 2, NAMES, torch.zeros(5).double(), 5)
    cells = [
        c._replace(value=c.value + 3 * toys.NUISANCE_STD_M * c.jacobian[:, -1] * (-1) ** k)
        for k, c in enumerate(ev.bins)
    ]
    rows = screen(toys.make_model_fit(ev.__class__(cells, 2, ev.hypotheses, ev.nuisance_stds, ev.mesh_differences)))
    assert max(abs(r.amplitude) / r.std for r in rows) < 4
    assert not any(r.decision == "present" for r in rows)


def test_the_level_of_slow_errors_is_found_also_beside_a_strong_effect():
    for truth in ([0.0] * 5, [0.0, 0.0, 0.0, 3.0, 0.0]):
        noise = fit_noise(toys.draw_linearisation(SLOPES, 2, NAMES, torch.tensor(truth).double(), 7))
        assert float(noise.levels[0]) == pytest.approx(toys.SLOW_ERROR_M, rel=0.35)


def test_the_slow_error_of_depths_is_found_and_is_no_error_of_places():
    """Images 1.5 mm too far or too near, for a while each, of cloth that faces the camera here and not there."""
    ev = toys.draw_linearisation(SLOPES, 2, NAMES, torch.zeros(5).double(), 7)
    rng, size, cells = torch.Generator().manual_seed(3), 1.5e-3, []
    for c in ev.bins:
        times = c.time.unique()
        memory = torch.linalg.cholesky(torch.exp(-(times[:, None] - times).abs() / CRITERIA.noise.slow_error_time_s))
        off = size * (memory @ torch.randn(len(times), generator=rng).double())[c.window]
        ray = torch.cos(10 * c.rest_position[:, 0])
        cells.append(c._replace(depth_slope=ray, value=c.value + ray * off))
    noise = fit_noise(replace(ev, bins=cells))
    assert noise.depth_level == pytest.approx(size, rel=0.4)
    assert float(noise.levels[0]) == pytest.approx(toys.SLOW_ERROR_M, rel=0.35)
    unaware = fit_noise(replace(ev, bins=[c._replace(depth_slope=torch.zeros_like(c.depth_slope)) for c in cells]))
    assert unaware.depth_level == 0, "nothing is known of a camera"
    assert float(unaware.levels[0]) > 1.3 * float(noise.levels[0])


def test_whitened_noise_is_white():
    ev = toys.draw_linearisation(SLOPES, 2, NAMES, torch.zeros(5).double(), 11)
    white = whiten(ev, fit_noise(ev)).value
    assert float(white.square().mean()) == pytest.approx(1.0, rel=0.2)
    assert abs(float((white[1:] * white[:-1]).mean())) < 4 / len(white) ** 0.5


def test_small_effects_are_absent_and_large_ones_present():
    assert row(asked([0.0, 0.0, 0.1, 0.0, 0.0]), "a").decision == "absent"  # 0.4 is the smallest of interest
    assert row(asked([0.0, 0.0, 1.0, 0.0, 0.0]), "a").decision == "present"


def test_what_cannot_be_seen_is_not_called_absent():
    faint = SLOPES.clone()
    faint[..., 4] *= 0.01  # a typical amplitude moves the cloth by 0.03 mm
    assert row(asked([0.0] * 5, slopes=faint), "c").decision == "unresolvable"


def test_what_is_too_large_to_be_believed_is_said():
    (small, large) = (asked([0.0, 0.0, 0.0, amplitude, 0.0]) for amplitude in (3.0, 6.0))
    assert not any(map(_is_implausibly_large, screen(small)))
    (said,) = (_warn_of_large_amplitude(r) for r in screen(large) if _is_implausibly_large(r))
    assert said.startswith("the residuals ask for b of ")
    assert "more than 5 is implausible" in said


@pytest.mark.parametrize("share", [-0.3, 0.3])
def test_what_a_further_mesh_has_more_or_less_of_is_no_cause(share):
    """The truth lies a third of the way to the coarser mesh, or beyond the finer: that looks like a hypothesis."""
    ev = toys.draw_linearisation(SLOPES, 2, NAMES, torch.zeros(5).double(), 0)
    generator = torch.Generator().manual_seed(3)
    numerics = []
    for c in ev.bins:  # mostly what "b" does, and something of its own
        own = torch.randn(len(c.value), generator=generator).double() * c.jacobian[:, 3].std()
        numerics.append(3.0 * (c.jacobian[:, 3] + 0.3 * own))
    cells = [c._replace(value=c.value + share * n) for c, n in zip(ev.bins, numerics, strict=True)]
    blind = row(toys.make_model_fit(ev.__class__(cells, 2, ev.hypotheses, ev.nuisance_stds, ev.mesh_differences)), "b")
    aware = row(toys.make_model_fit(ev.__class__(cells, 2, ev.hypotheses, ev.nuisance_stds, numerics)), "b")
    assert abs(blind.amplitude) > 10 * blind.std
    assert abs(aware.amplitude) < 2.5 * aware.std
    assert aware.std < 2 * abs(share) * 3.0 / toys.EPISODE_COUNT**0.5  # episodes have their own share each


def test_numerics_widen_the_error():
    ev = toys.draw_linearisation(SLOPES, 2, NAMES, torch.tensor([0.0, 0.0, 0.0, 0.6, 0.0]).double(), 2)
    shifted = [-3 * 0.5 * c.jacobian[:, 3] for c in ev.bins]  # the coarser mesh errs like b at 1.5
    plain = row(toys.make_model_fit(ev), "b")
    wide = row(toys.make_model_fit(ev.__class__(ev.bins, 2, ev.hypotheses, ev.nuisance_stds, shifted)), "b")
    assert wide.mesh_bias == pytest.approx(0.5, rel=0.1)
    assert plain.decision == "present"
    assert wide.decision != "present"


def test_what_a_fitted_parameter_does_as_well_is_known_by_its_prior_alone():
    found = asked([0.0, 0.0, 0.7, 0.0, 0.0])
    hypotheses = [toys.make_hypothesis("a", equivalent_parameter="p1"), *found.linearisation.hypotheses[1:]]
    found = replace(found, linearisation=replace(found.linearisation, hypotheses=hypotheses))
    assert row(found, "a").decision == "unresolvable"
    far = replace(found, model=found.model.at_point(torch.tensor([0.0, 4 * 0.5]).double()))
    stranger = replace(
        far, linearisation=replace(far.linearisation, hypotheses=[toys.make_hypothesis("a"), *hypotheses[1:]])
    )
    apart = ("hypothesis", "position_rms")
    alike = [{k: v for k, v in row(f, "a")._asdict().items() if k not in apart} for f in (far, stranger)]
    assert alike[0] == alike[1], "asked about as any other"


def test_beside_a_parameter_that_its_prior_holds_its_twin_asks_for_what_both_would_take_together():
    """A data sheet that is known to 5 %, and 0.7 off: the parameter gives way, and its prior pulls back."""
    same = SLOPES.clone()
    same[..., 2] = same[..., 1]
    found = asked([0.0, 0.0, 0.7, 0.0, 0.0], slopes=same, std=0.05)
    twins = [toys.make_hypothesis("a", equivalent_parameter="p1"), *found.linearisation.hypotheses[1:]]
    found = replace(found, linearisation=replace(found.linearisation, hypotheses=twins))
    step, _ = gauss_newton_step(found.whitened, found.model)
    cells = [c._replace(value=c.value + c.jacobian[:, :2] @ step) for c in found.linearisation.bins]
    evidence = replace(found.linearisation, bins=cells)
    there = replace(
        found, model=found.model.at_point(step), linearisation=evidence, whitened=whiten(evidence, found.noise)
    )
    both = there.whitened.jacobian[:, :3]
    prior = torch.diag(torch.tensor([0.05**-2, 0.05**-2, 0.0]).double())
    at = torch.nn.functional.pad(there.model.point, (0, 1))
    wanted = -torch.linalg.solve(both.mT @ both + prior, both.mT @ there.whitened.value + prior @ at)
    twin = row(there, "a")
    assert twin.amplitude == pytest.approx(float(wanted[2]), rel=1e-6)
    assert twin.amplitude == pytest.approx(0.7, abs=3 * twin.std)
    assert twin.position_rms > 1e-3, "what it moves is not hidden by the parameter that does the same"


def test_what_is_rough_is_noise_of_its_stretch():
    ev = toys.draw_linearisation(SLOPES, 2, ["a", "b", "c"], torch.zeros(5).double(), 0)
    rough = 3e-3 * (ev.bins[0].window == 2)
    cells = [ev.bins[0]._replace(roughness=rough), *ev.bins[1:]]
    level = torch.full((len(KINDS),), toys.SLOW_ERROR_M).double()
    none = torch.zeros(len(rough), 0).double()
    plain, wide = (Noise(level).covariance(c[0], none, none[0]) for c in (ev.bins, cells))
    more = (wide - plain).diagonal()
    assert torch.equal(more > 0, rough > 0)
    torch.testing.assert_close(more[rough > 0], (CRITERIA.noise.roughness_steps * rough[rough > 0]) ** 2)
    assert torch.linalg.eigvalsh(wide).min() > 0


def test_twins_form_a_class_and_strangers_do_not():
    same = SLOPES.clone()
    same[..., 3] = 1.5 * same[..., 2] + 1e-4 * same[..., 4]  # b is a, but for a trifle
    found = asked([0.0, 0.0, 1.0, 0.0, 0.0], slopes=same)
    rows = {r.hypothesis.name: r for r in screen(found)}
    assert float(correlate_scores(found)[0, 1]) > 0.99
    assert [r.hypothesis.name for r in find_confounded(found, rows["a"], 1.0, [rows["b"], rows["c"]])] == ["b"]


def test_what_would_need_a_sign_that_it_cannot_have_is_no_twin():
    """Less friction and more adhesion do the opposite: adhesion cannot have been taken away."""
    against = SLOPES.clone()
    against[..., 3] = -1.5 * against[..., 2] + 1e-4 * against[..., 4]
    found = asked([0.0, 0.0, 1.0, 0.0, 0.0], slopes=against)
    rows = {r.hypothesis.name: r for r in screen(found)}
    other = rows["b"]._replace(hypothesis=replace(rows["b"].hypothesis, signed=False))
    assert find_confounded(found, rows["a"], 1.0, [other]) == []
    (instead,) = find_confounded(found, rows["a"], -1.0, [other])  # slopes ask for less than none of it
    assert other.amplitude == pytest.approx(-1 / 1.5, rel=0.1)
    assert instead.amplitude == pytest.approx(1 / 1.5, rel=0.01)
    assert find_confounded(found, rows["a"], 1.0, [rows["b"]]) == [rows["b"]]


def test_what_a_fit_finds_tells_it_from_strangers_though_a_score_found_little():
    """A cause that slopes where it was asked about hardly showed is not alike everything."""
    found = asked([0.0, 0.0, 1.0, 0.0, 0.0])
    rows = {r.hypothesis.name: r for r in screen(found)}
    little, others = rows["a"]._replace(chi2=1.0), [rows["b"], rows["c"]]
    assert len(find_confounded(found, little, 0.0, others)) == 2
    assert find_confounded(found, little, 1.0, others) == []


def test_more_scatter_within_cells_is_no_gain():
    """Of two models that leave the same residuals neither is the likelier, however their points scatter."""
    ev = toys.draw_linearisation(SLOPES, 2, NAMES, torch.zeros(5).double(), 3)
    cells = [
        c._replace(
            row_std=1.1 * c.row_std,
            count=c.count - 1,
            roughness=c.roughness + 1e-4,
            depth_slope=c.depth_slope + 0.2,
            time=c.time + 0.01,
            rest_position=1.1 * c.rest_position,
        )
        for c in ev.bins
    ]
    groups, one, other = ["x", "y", "x", "y"], toys.make_model_fit(ev), toys.make_model_fit(replace(ev, bins=cells))
    like = [reweight_by_noise(found, one.noise, one.linearisation) for found in (one, other)]
    first, same, more = (
        predict_held_out(found, groups) for found in (*like, reweight_by_noise(other, one.noise, other.linearisation))
    )
    assert compare(first, same, 1e-3).log_density == pytest.approx(0.0, abs=1e-9)
    assert abs(compare(first, more, 1e-3).log_density) > CRITERIA.candidate.equal_density


def test_models_that_meet_other_cells_are_compared_on_those_that_both_meet():
    """The same residuals are no gain, whichever of the two has met fewer of them."""
    ev = toys.draw_linearisation(SLOPES, 2, NAMES, torch.zeros(5).double(), 3)
    rough = replace(ev, bins=[c._replace(roughness=1e-3 * torch.rand(len(c.value))) for c in ev.bins])
    fewer = [c.select(slice(5, None)) for c in rough.bins]
    less = replace(
        ev,
        bins=[c._replace(row_std=2 * c.row_std) for c in fewer],
        mesh_differences=[n[5:] for n in ev.mesh_differences],
    )
    for own, taken in zip(ev.bins, use_noise_inputs(ev, less).bins, strict=True):
        assert torch.equal(taken.key, own.key[5:])
        assert torch.equal(taken.row_std, 2 * own.row_std[5:])
    groups, one, other = (
        ["x", "y", "x", "y"],
        toys.make_model_fit(rough),
        toys.make_model_fit(replace(less, bins=fewer)),
    )
    for both in ((one, other), (other, one)):
        first, second = (predict_held_out(found, groups) for found in put_on_common_noise(*both))
        assert compare(first, second, 1e-3).log_density == pytest.approx(0.0, abs=1e-9)


def test_an_episode_without_a_cell_says_nothing():
    ev = toys.draw_linearisation(SLOPES, 2, NAMES, torch.zeros(5).double(), 3)
    none = ev.bins[0].select(slice(0))
    empty = replace(
        ev, bins=[none, *ev.bins[1:]], mesh_differences=[ev.mesh_differences[0][:0], *ev.mesh_differences[1:]]
    )
    rest = replace(ev, bins=ev.bins[1:], mesh_differences=ev.mesh_differences[1:], nuisance_stds=ev.nuisance_stds[1:])
    noise = fit_noise(empty)
    assert torch.equal(noise.levels, fit_noise(rest).levels)
    assert torch.equal(whiten(empty, noise).value, whiten(rest, noise).value)
    alike = use_noise_inputs(ev, empty)
    assert [len(c.value) for c in alike.bins] == [0, *(len(c.value) for c in ev.bins[1:])]
    assert torch.isfinite(whiten(alike, noise).value).all()
    blind = toys.make_model_fit(empty)
    first = select_episodes(predict_held_out(blind, list("wxyz")), [0])
    gain = compare(first, first, 1e-3)  # of a motion alone
    assert math.isnan(gain.rms_before)
    assert (gain.log_density, gain.log_density_ci95) == (0.0, (0.0, 0.0))
    forces = replace(ev, bins=[c._replace(block=torch.full_like(c.block, FORCE_BLOCK)) for c in ev.bins])
    with pytest.raises(InvalidInput, match="no part of the cloth whose response"):
        compute_noise_floor(forces, noise)


def test_a_true_cause_predicts_motions_that_were_held_out():
    """The gain is what the effect did; a model without it predicts them no better than itself."""
    truth = torch.tensor([0.2, 0.0, 0.0, 1.0, 0.0]).double()
    ev = toys.draw_linearisation(SLOPES, 2, NAMES, truth, 4)
    groups = ["x", "y", "x", "y"]
    without = predict_held_out(toys.make_model_fit(ev), groups)
    order = [0, 1, 3, 2, 4, 5]  # b joins what is fitted
    cells = [c._replace(jacobian=c.jacobian[:, order]) for c in ev.bins]
    with_b = ev.__class__(cells, 3, [ev.hypotheses[0], ev.hypotheses[2]], ev.nuisance_stds, ev.mesh_differences)
    after = predict_held_out(toys.make_model_fit(with_b, std=2.0), groups)
    floor = compute_noise_floor(ev, toys.make_model_fit(ev).noise)
    gain = compare(without, after, floor)
    assert gain.log_density_ci95[0] > 0
    assert gain.rms_after < 0.6 * gain.rms_before
    assert gain.explained_fraction > 0.8
    same = compare(without, without, floor)
    assert same.log_density == 0.0
    assert (
        compare(without, after, 2 * gain.rms_before).explained_fraction == 1.0
    )  # below the floor there is nothing more to gain
    assert compare(after, without, 2 * gain.rms_before).explained_fraction == -1.0
    assert same.explained_fraction == 0.0


def test_a_wrong_cause_does_not_predict_them():
    """With nothing to explain, one more number predicts worse, if anything."""
    gains = []
    for seed in range(12):
        ev = toys.draw_linearisation(SLOPES, 2, NAMES, torch.zeros(5).double(), 50 + seed)
        more = ev.__class__(ev.bins, 3, ev.hypotheses[1:], ev.nuisance_stds, ev.mesh_differences)
        groups = ["x", "y", "x", "y"]
        gains.append(
            compare(
                predict_held_out(toys.make_model_fit(ev), groups),
                predict_held_out(toys.make_model_fit(more), groups),
                1e-3,
            ).log_density_ci95[0]
            > 0
        )
    assert sum(gains) <= 1


def test_what_shows_in_one_episode_shows_however_many_others_there_are():
    """Slopes of one of four episodes only: the size is theirs, and the means over all would be half of it."""
    slopes = SLOPES.clone()
    slopes[1:, :, 2] = 0.0
    size = row(asked([0.0, 0.0, 0.0, 0.0, 0.0], slopes=slopes), "a").position_rms
    own = float(slopes[0, :, 2].square().mean().sqrt())
    assert 0.5 * own < size <= own
    assert size > 1.5 * float(slopes[..., 2].square().mean().sqrt())


@pytest.mark.parametrize(
    ("reached", "worth", "said"), [(0.5, 20.0, "inconclusive"), (0.5, 2.0, "absent"), (0.3, 20.0, "absent")]
)
def test_what_a_leap_makes_large_is_not_ruled_out_by_slopes(reached, worth, said):
    """Large effects bend the fit until slopes there ask for less than there is."""
    asks = ScoreTest(toys.make_hypothesis("a"), 0.2, 0.01, 0.0, 400.0, 1e-2, 0.0, reached, worth, "absent")
    assert _decide(asks) == said


@pytest.mark.parametrize(
    ("amplitude", "signed", "decision", "wrong"),
    [(-0.5, False, "absent", True), (-0.5, True, "present", False), (-0.3, False, "absent", False)],
)
def test_what_would_matter_but_for_its_sign_is_no_trifle(amplitude, signed, decision, wrong):
    h = replace(toys.make_hypothesis("a"), signed=signed)
    assert ScoreTest(h, amplitude, 0.01, 0.0, 400.0, 1e-2, 0.0, amplitude, 20.0, decision).has_wrong_sign == wrong


def test_two_that_were_fitted_are_alike_where_what_lies_between_them_is_within_three_standard_deviations():
    found = asked([0.0] * 5)
    unit = float(found.whitened.jacobian[:, 3].norm())

    def moved(chi_squared):
        """Another model: what it says is so far from what the first one says."""
        far = chi_squared**0.5 / unit
        cells = [c._replace(value=c.value + far * c.jacobian[:, 3]) for c in found.linearisation.bins]
        fewer = [c.select(slice(1, None)) for c in cells]  # cells that only one of them has do not count
        numerics = [n[1:] for n in found.linearisation.mesh_differences]
        return replace(found, linearisation=replace(found.linearisation, bins=fewer, mesh_differences=numerics))

    for louder in (1.0, 3.0):  # by the noise that is given, not by that of the fits
        noise = Noise(found.noise.levels * louder)
        floor = whiten(found.linearisation, noise).jacobian[:, 3].norm() / unit
        assert are_fits_confounded(found, moved(0.8 * CRITERIA.confounding.max_chi2 / float(floor) ** 2), noise)
        assert not are_fits_confounded(moved(1.3 * CRITERIA.confounding.max_chi2 / float(floor) ** 2), found, noise)


@pytest.mark.parametrize(
    "stretches", [2, pytest.param(3, marks=pytest.mark.slow), pytest.param(4, marks=pytest.mark.slow)]
)
def test_intervals_by_stretches_of_time_are_as_wide_as_few_of_them_allow(stretches):
    """Drawn with replacement alone, six episodes of two stretches would surely gain by nothing in 9 % of cases."""
    owner, rng = np.arange(6).repeat(stretches), np.random.default_rng(0)
    surely = 0
    for k in range(1000):
        sums = _resample_blocks(owner, np.random.default_rng(k)) @ rng.standard_normal(len(owner))
        surely += float(np.quantile(sums, 0.025)) > 0
    assert surely / 1000 < 0.06  # 3 to 5 % by so few; 2.5 % of many


def test_a_single_stretch_of_time_confirms_nothing():
    blank = asked([0.0] * 5, slopes=SLOPES)
    first = predict_as_given(blank)
    short = select_episodes(first, [0])
    short = HeldOutPrediction(*(column[first.window[first.episode == 0] < 2] for column in short))
    better = short._replace(residual=0.5 * short.residual, whitened=0.5 * short.whitened)
    gain = compare(short, better, 0.0)
    assert gain.log_density > 0
    assert gain.log_density_ci95[0] == gain.log_density_ci95[1]
    assert not Confirmation(gain, {}, 0.0, "the model", ("base.tcm", "extended.tcm"), ["e1"]).is_confirmed


def test_what_is_surely_there_is_present_though_a_usual_amount_of_it_could_not_be_seen():
    ev = toys.draw_linearisation(toys.draw_jacobian(5, 4), 2, ["X"], torch.tensor([0.0, 0.0, 0.3]), 0)
    small = replace(ev, hypotheses=[replace(ev.hypotheses[0], typical=0.06)])
    (row,) = screen(toys.make_model_fit(small))
    assert row.visibility < 1 < row.visibility * row.amplitude / 0.06
    assert row.decision == "present"
    less = toys.draw_linearisation(toys.draw_jacobian(5, 4), 2, ["X"], torch.tensor([0.0, 0.0, 0.03]), 0)
    (row,) = screen(toys.make_model_fit(replace(less, hypotheses=small.hypotheses)))
    assert row.decision == "unresolvable"
