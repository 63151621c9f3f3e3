"""Robust weights of time blocks: against the formula, and on stretches that a wrong model distorts."""

from dataclasses import replace

import pytest
import torch
from helpers import linear_evidence as toys

from torchcloth.diagnosis.data.binning import time_blocks
from torchcloth.diagnosis.decide.criteria import CRITERIA
from torchcloth.diagnosis.inference.comparison import compare, predict_held_out
from torchcloth.diagnosis.inference.fitting import gauss_newton_step
from torchcloth.diagnosis.inference.noise import Noise, whiten
from torchcloth.diagnosis.inference.robust_weights import reweight, t_log_density, t_weights

SLOPES = toys.draw_jacobian(1, 4)  # three parameters, one nuisance
TRUTH = torch.tensor([0.2, -0.3, 0.7]).double()
LEVEL = Noise(torch.full((5,), toys.SLOW_ERROR_M).double())


def drawn(seed, flipped=0.0, truth=TRUTH):
    """Evidence in which the cloth of one episode lies ``flipped`` metres off for two of its six windows."""
    ev = toys.draw_linearisation(SLOPES, 3, [], truth, seed)
    first = ev.bins[0]
    away = flipped * ((first.window == 2) | (first.window == 3)).double()
    return ev.__class__(
        [first._replace(value=first.value + away), *ev.bins[1:]], 3, [], ev.nuisance_stds, ev.mesh_differences
    )


def test_a_stretch_that_fits_counts_in_full_and_another_by_the_formula():
    stretch = torch.tensor([0, 0, 0, 0, 1, 1])
    value = torch.tensor([0.5, -0.5, 1.0, 0.1, 10.0, 20.0]).double()
    assert t_weights(value, stretch).tolist() == pytest.approx(
        [1.0] * 4 + [(CRITERIA.robust.t_dof + 2) / (CRITERIA.robust.t_dof + 500)] * 2
    )


def test_the_weights_are_the_slope_of_the_density():
    """d log p / d r = -w r where the weight is below one: least squares with these weights maximises it."""
    stretch, value = torch.tensor([0, 0, 0]), torch.tensor([4.0, -6.0, 3.0]).double().requires_grad_()
    (slope,) = torch.autograd.grad(t_log_density(value, stretch).sum(), value)
    assert torch.allclose(slope, -t_weights(value.detach(), stretch) * value.detach(), rtol=1e-12)


def test_kinds_windows_and_episodes_are_stretches_of_their_own():
    ev = drawn(0)
    two = torch.cat([torch.zeros(48), torch.ones(48)]).long()
    cells = [ev.bins[0]._replace(block=two), ev.bins[1]]
    assert len(time_blocks(cells).unique()) == 2 * toys.WINDOW_COUNT + toys.WINDOW_COUNT


def test_cloth_that_folds_over_for_a_while_moves_no_parameter():
    """In 20 draws 30 mm in two windows of 24 bend least squares by many of its errors, and weighted ones by none."""
    plain, calm = [], []
    for seed in range(20):
        ev = drawn(seed, 0.03)
        model = toys.make_model_fit(ev).model
        for white, out in ((whiten(ev, LEVEL), plain), (reweight(whiten(ev, LEVEL)), calm)):
            step, _ = gauss_newton_step(white, model)
            own = white.jacobian[:, :3]
            error = torch.linalg.inv(own.mT @ own + 4 * torch.eye(3).double()).diagonal().sqrt()
            out.append((step - TRUTH) / error)
    assert float(torch.stack(plain).square().mean().sqrt()) > 3.0
    assert float(torch.stack(calm).square().mean().sqrt()) < 1.5


def test_where_all_fits_nothing_changes():
    ev = drawn(3, truth=torch.zeros(3).double())
    quiet = ev.__class__(
        [c._replace(value=0.5 * c.value) for c in ev.bins], 3, [], ev.nuisance_stds, ev.mesh_differences
    )
    assert torch.equal(reweight(whiten(quiet, LEVEL)).value, whiten(quiet, LEVEL).value)


def test_a_number_that_the_others_leave_open_is_no_failure_of_the_prediction():
    """Only the first motion tells of the third parameter: with and without it, the others predict the first as well."""
    slopes = SLOPES.clone()
    slopes[1:, :, 2] = 0.0
    ev = toys.draw_linearisation(slopes, 3, [], torch.tensor([0.0, 0.0, 0.5]).double(), 0)
    less = ev.__class__(
        [c._replace(jacobian=c.jacobian[:, [0, 1, 3]]) for c in ev.bins], 2, [], ev.nuisance_stds, ev.mesh_differences
    )
    groups = ["a", "b", "c", "d"]
    whole = compare(
        predict_held_out(toys.make_model_fit(less), groups),
        predict_held_out(toys.make_model_fit(ev, std=1.0), groups),
        0.0,
    )
    assert whole.log_density > 10.0  # that it may be anything is far better than that it is zero
    assert whole.robust_rms[1] < whole.robust_rms[0]


def test_what_ripples_does_not_count_in_millimetres():
    """Two windows that noise of roughness describes are centimetres off: with it the others are what one sees."""
    away = drawn(0, 0.03)
    rough = 0.02 * ((away.bins[0].window == 2) | (away.bins[0].window == 3)).double()
    known = replace(away, bins=[away.bins[0]._replace(roughness=rough), *away.bins[1:]])
    plain, told = (predict_held_out(toys.make_model_fit(ev), list("abcd")) for ev in (drawn(0), known))
    assert float(told.smooth_fraction.min()) < 1e-3
    assert float(told.smooth_fraction[told.episode > 0].min()) == 1.0
    assert compare(told, told, 0.0).rms_before > 3 * compare(plain, plain, 0.0).rms_before
    assert compare(told, told, 0.0).robust_rms[0] < 1.2 * compare(plain, plain, 0.0).robust_rms[0]


def test_what_one_episode_tells_is_not_thinned_by_the_others():
    """A millimetre is mended in one of four episodes."""
    told = predict_held_out(toys.make_model_fit(drawn(0)), list("abcd"))
    first = (told.episode == 0).double()
    wrong = told._replace(residual=told.residual + 1e-3 * first)
    gain = compare(wrong, told, 0.0)
    assert gain.rms_removed[0] == pytest.approx(1e-3, rel=0.3)
    assert (gain.robust_rms[0] ** 2 - gain.robust_rms[1] ** 2) ** 0.5 < 0.7 * gain.rms_removed[0]
    assert gain.rms_removed[1] == 0.0
