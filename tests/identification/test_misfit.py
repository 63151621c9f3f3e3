"""A misfit that lasts widens the errors, and noise of single readings does not."""

import math
from dataclasses import replace

import pytest
import torch
from helpers import least_squares, twins

from torchcloth.episodes.unknowns import collect_unknowns
from torchcloth.errors import InvalidInput
from torchcloth.identification import build_episode, identify
from torchcloth.identification.estimators.levenberg_marquardt import minimise
from torchcloth.identification.uncertainty.misfit import misfit_variance, split_residuals
from torchcloth.identification.uncertainty.model_error import ModelErrors, add_model_error

FRAMES, PARTS, POINTS = 40, 16, 30
NOISE_M = 1e-3


def toy(lasting, seed=0):
    """A slope that differs by part of the fabric; errors of single readings, and one of each part that lasts.

    Returns:
        The problem, and the number of the episode of every row.
    """
    generator = torch.Generator().manual_seed(seed)
    frame = torch.arange(FRAMES).repeat_interleave(PARTS * POINTS)
    part = torch.arange(PARTS).repeat_interleave(POINTS).repeat(FRAMES)
    slope = torch.sin(0.3 * frame + part).double()
    noise = NOISE_M * torch.randn(len(frame), generator=generator, dtype=torch.float64)
    common = lasting * torch.randn(PARTS, generator=generator, dtype=torch.float64)
    data = 0.5 * slope + noise + common[part]
    problem = least_squares.ToyProblem(lambda raw: raw[0] * slope, data, frame, part, unknowns=1)
    return problem, torch.zeros_like(frame)


def solve(problem):
    return minimise(problem.problem(), torch.zeros(1, dtype=torch.float64), 20, lambda _: False)


@pytest.mark.parametrize("lasting", [0.0, 5e-4, 3e-3])
def test_noise_of_readings_and_what_lasts_are_told_apart(lasting):
    problem, episode = toy(lasting)
    split = split_residuals(solve(problem), episode)
    assert math.sqrt(split.total) == pytest.approx(math.hypot(NOISE_M, lasting), rel=0.25)
    assert math.sqrt(split.shared) == pytest.approx(lasting, rel=0.5, abs=0.05 * NOISE_M)


def test_a_single_frame_shows_no_difference_so_all_of_it_may_last():
    problem, episode = toy(0.0)
    at = solve(problem)
    one = at._replace(linear=at.linear._replace(frame=torch.zeros_like(at.linear.frame)))
    split = split_residuals(one, episode)
    assert float(split.shared) == float(split.total)


def test_errors_that_follow_the_cloth_are_covered():
    """The worst time course of a part is that of its slope: a sensor's scale factor that differs from part to part."""
    hits = []
    for seed in range(40):
        problem, episode = toy(0.0, seed)
        generator = torch.Generator().manual_seed(1000 + seed)
        scale = 1e-3 * torch.randn(PARTS, generator=generator, dtype=torch.float64)
        slope = problem.model(torch.ones(1, dtype=torch.float64))
        problem.data = problem.data + scale[problem.patch] * slope.sign()
        at = solve(problem)
        variance = misfit_variance(problem.problem(), at, episode, split_residuals(at, episode).shared)
        hits.append(abs(float(at.raw) - 0.5) < 1.96 * float(variance) ** 0.5)
    assert sum(hits) / len(hits) >= 0.9


def test_parameters_that_were_measured_have_no_error_of_the_simulator(recording):
    unknowns = collect_unknowns(twins.build_cloth_at(recording), ["youngs_modulus", "bending.stiffness"], (0.3, 5e-3))
    raw = torch.tensor([u.start for u in unknowns], dtype=torch.float64)
    covariance = add_model_error(unknowns, raw, torch.zeros(3, 3, dtype=torch.float64), ModelErrors(0.2, 0.1))
    relative = [
        u.slope(r) * s / u.value(r)
        for u, r, s in zip(unknowns, raw.tolist(), covariance.diagonal().sqrt().tolist(), strict=True)
    ]
    assert [u.name for u in unknowns] == ["youngs_modulus", "bending.stiffness", "areal_density"]
    assert relative == pytest.approx([0.1, 0.2, 0.0])


def test_frozen_clouds_are_left_out_of_a_fit_unless_checks_are_off(model, brief):
    """Five equal clouds while the hands moved once made stiffness 6 % too small, without a word."""
    points = brief.points
    frames = [points.frame(min(i, 2)) for i in range(len(points))]
    frozen = replace(brief, points=replace(points, xyz=torch.cat([torch.as_tensor(f) for f in frames]).numpy()))
    checked = identify(model, frozen, ["youngs_modulus"], iterations=1, exact_bench=True)
    assert any("equal the one before" in w for w in checked.warnings)
    unchecked = identify(model, frozen, ["youngs_modulus"], iterations=1, checks=False, exact_bench=True)
    assert not any("equal the one before" in w for w in unchecked.warnings)
    assert checked.fit["points"] < unchecked.fit["points"]


def test_grippers_that_are_exchanged_are_refused(model, brief):
    hands = {"left": brief.grippers["right"], "right": brief.grippers["left"]}
    with pytest.raises(InvalidInput, match=r"'left' and 'right'.*exchange the names"):
        identify(model, replace(brief, grippers=hands), ["youngs_modulus"], iterations=1)


def test_grippers_that_are_still_open_may_be_anywhere(model, brief):
    """They come for the cloth later, so where they are at first says nothing of the names."""
    open_ = {name: replace(hand, closed=hand.t > 0.2) for name, hand in brief.grippers.items()}
    hands = {"left": open_["right"], "right": open_["left"]}
    assert len(build_episode(model, replace(brief, grippers=hands)).clouds) == len(brief.points)
