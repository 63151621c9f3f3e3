"""Errors from the scatter between episodes, where something differs between them that was not fitted."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import scipy.stats
import torch
from helpers import least_squares

from torchcloth import recordings as rec
from torchcloth.identification.estimators import levenberg_marquardt
from torchcloth.identification.estimators.levenberg_marquardt import (
    DEFAULT_NOISE_MODEL,
    covariance,
    inflate_covariance,
    minimise,
    student_quantile,
)
from torchcloth.identification.estimators.linearity import LinearityCheck
from torchcloth.identification.uncertainty import replicates
from torchcloth.identification.uncertainty.consider_covariance import solution_covariance
from torchcloth.identification.uncertainty.replicates import assign_strata

HIDDEN = 0.05  # standard deviation of what differs between episodes, in units of the unknowns
FRAMES = 12


def repeats(seed, count, motions=1, hidden=HIDDEN, offset=0.0):
    """(problem of ``count`` episodes of each motion, each with values of its own; episode of each row).

    The estimate is the truth and the mean of what differs: its error is known in closed form.
    """
    generator = torch.Generator().manual_seed(seed)
    jacobian, data, frame, patch, episode = [], [], [], [], []
    for motion in range(motions):
        of_part = least_squares.draw_jacobian(generator, FRAMES)
        for _ in range(count):
            value = (
                least_squares.TRUE_UNKNOWNS
                + hidden * torch.randn(3, generator=generator, dtype=torch.float64)
                + offset * motion
            )
            number, (t, where) = len(jacobian), least_squares.row_layout(FRAMES)
            jacobian.append(of_part)
            data.append(of_part @ value + 0.1 * least_squares.draw_noise(generator, 0.0, FRAMES))
            frame.append(t + number * (FRAMES + DEFAULT_NOISE_MODEL.frames_per_time_block + 1))
            patch.append(where)
            episode.append(torch.full_like(t, number))
    J = torch.cat(jacobian)
    toy = least_squares.ToyProblem(
        lambda raw: J @ raw, torch.cat(data), torch.cat(frame), torch.cat(patch), prior_std=1e3
    )
    return toy, torch.cat(episode)


def result(seed, count, motions=1, strata=None, scatter=True, **options):
    toy, episode = repeats(seed, count, motions, **options)
    at = minimise(toy.problem(), least_squares.TRUE_UNKNOWNS.clone(), 20, lambda _: False)
    matrix = covariance(toy.problem(), at)
    if scatter:
        strata = torch.zeros(count * motions, dtype=torch.int64) if strata is None else strata
        matrix = inflate_covariance(matrix, replicates.jackknife_variance(toy.problem(), at, episode, strata))
    return at.raw - least_squares.TRUE_UNKNOWNS, matrix.diagonal().sqrt()


@pytest.mark.slow
@pytest.mark.parametrize("count", [3, 6])
def test_intervals_cover_what_differs_between_episodes(count):
    """95 % of 300; without the scatter far fewer, because within an episode all frames agree on a wrong value."""
    covered, blind = [], []
    for seed in range(100):
        for scatter, stored in ((True, covered), (False, blind)):
            error, std = result(seed, count, scatter=scatter)
            stored.append((error.abs() < 1.96 * std).double())
    assert 0.90 <= float(torch.stack(covered).mean()) <= 0.995
    assert float(torch.stack(blind).mean()) < 0.75


@pytest.mark.slow
def test_errors_are_those_of_a_mean_of_episodes():
    """Root mean square over seeds: what differs over sqrt n, widened as Student's t for so few."""
    stds = torch.stack([result(seed, 6)[1] for seed in range(60)])
    wanted = HIDDEN / 6**0.5 * scipy.stats.t.ppf(0.975, 5) / 1.96
    assert float(stds.square().mean().sqrt()) == pytest.approx(wanted, rel=0.12)


def test_leaving_out_an_episode_moves_the_estimate_as_a_fit_shift_without_it_does():
    """Episodes that differ much: what was an outlier among all is none without the one that made the others small."""
    toy, episode = repeats(1, 3, hidden=0.5)
    whole = minimise(toy.problem(), least_squares.TRUE_UNKNOWNS.clone(), 20, lambda _: False)
    for e in range(3):
        stored = episode != e
        J = torch.func.jacfwd(toy.model)(least_squares.TRUE_UNKNOWNS)[stored]
        alone = least_squares.ToyProblem(
            lambda raw, J=J: J @ raw, toy.data[stored], toy.frame[stored], toy.patch[stored], prior_std=1e3
        )
        wanted = minimise(alone.problem(), least_squares.TRUE_UNKNOWNS.clone(), 20, lambda _: False).raw - whole.raw
        moved = replicates._shift_without(toy.problem(), whole, ~stored)
        assert float((moved - wanted).norm()) < 0.1 * float(wanted.norm())


def test_episodes_shift_without_data_of_a_kind_do_not_scatter():
    """One of three alone has readings: without it there is no fit, and the others move nothing."""
    toy, episode = repeats(1, 3)
    at = minimise(toy.problem(), least_squares.TRUE_UNKNOWNS.clone(), 20, lambda _: False)
    alone = torch.zeros_like(episode)
    assert torch.equal(
        replicates.jackknife_variance(toy.problem(), at, alone, torch.zeros(3).long()), torch.zeros_like(at.raw)
    )


@pytest.mark.slow
def test_only_replicates_scatter():
    """Two motions whose values differ by far more than replicates of one: that difference is not scatter."""
    strata, options = torch.tensor([1, 1, 1, 2, 2, 2]), {"motions": 2, "offset": 0.5}
    within, mixed, none = (
        torch.stack([result(seed, 3, **options, **how)[1] for seed in range(10)]).mean(0)
        for how in ({"strata": strata}, {}, {"scatter": False})
    )
    assert bool((within < 1.2 * none).all())
    assert bool((mixed > 1.5 * within).all())


@pytest.mark.parametrize("freedom", [2, 3, 4, 9, 50])
def test_students_quantile(freedom):
    assert student_quantile(freedom) == pytest.approx(scipy.stats.t.ppf(0.975, freedom), rel=1e-12)


def named(name, **split):
    path = Path("somewhere") / name if name else None
    return rec.Recording(cloth=rec.ClothInfo(areal_density=1.0), provenance="measured", split=split, path=path)


@pytest.mark.parametrize(
    ("episodes", "strata"),
    [
        ([named("a", motion="m"), named("b", motion="m"), named("c", motion="m"), named("d")], [1, 1, 1, 0]),
        ([named("a"), named("b", replicate_of="a"), named("c", replicate_of="b"), named("d")], [1, 1, 1, 0]),
        ([named("b", replicate_of="a"), named("c", replicate_of="a"), named("d", replicate_of="a")], [1, 1, 1]),
        ([named("a", motion="m"), named("b", replicate_of="a"), named("c", motion="m")], [1, 1, 1]),
        ([named("a", replicate_of="b"), named("b", replicate_of="a"), named("c")], [0, 0, 0]),
        ([named(None), named(None), named(None)], [0, 0, 0]),
        ([named("a", motion="m"), named("b", motion="n"), named("c", motion="m"), named("d", motion="n")], [0] * 4),
    ],
)
def test_episodes_repeat_each_other_when_they_say_so(episodes, strata):
    assert assign_strata(episodes).tolist() == strata


def test_folders_of_one_name_are_other_episodes():
    """Three days' "ep" are no repetitions; what repeats one is that of its own day."""

    def at(path, **split):
        return SimpleNamespace(path=Path(path), split=split)

    assert assign_strata([at(f"day{k}/ep") for k in range(3)]).tolist() == [0, 0, 0]
    repeated = [at(f"day{k}/{name}", **said) for k in range(2) for name, said in REPEATED]
    assert assign_strata(repeated).tolist() == [1, 1, 1, 2, 2, 2]


REPEATED = (("ep", {}), ("again", {"replicate_of": "ep"}), ("third", {"replicate_of": "again"}))


def test_nuisances_of_an_episode_do_not_scatter():
    """Without its own episode an offset goes back to its prior's middle: that says nothing of its error."""
    torch.manual_seed(0)
    episodes, frames, points, sigma = 4, 12, 16, 1e-4
    offsets = 5e-3 * torch.ones(episodes)
    slopes, frame, patch, of_part = [], [], [], []
    for e in range(episodes):
        jacobian = torch.zeros(frames, points, 1 + episodes)
        jacobian[..., 0] = -0.01 * torch.rand(frames, points)
        jacobian[..., 1 + e] = -(torch.rand(frames, points) > 0.5).double()
        slopes.append(jacobian.reshape(-1, 1 + episodes))
        t, where = torch.meshgrid(torch.arange(frames), torch.arange(points), indexing="ij")
        frame.append(t.reshape(-1) + e * (frames + DEFAULT_NOISE_MODEL.frames_per_time_block))
        patch.append(where.reshape(-1))
        of_part.append(torch.full((frames * points,), e))
    J, frame, patch, of_part = map(torch.cat, (slopes, frame, patch, of_part))
    data = -J @ torch.cat([torch.ones(1), offsets]) + sigma * torch.randn(len(J))

    def value(raw):
        return data + J @ raw

    problem = levenberg_marquardt.Problem(
        lambda raw: levenberg_marquardt.Linearised(value(raw), J, torch.ones(len(J)), frame, patch),
        lambda raw: (value(raw), patch),
        lambda raw: raw,
        torch.zeros(1 + episodes),
        torch.tensor([2.3] + [2e-3] * episodes),
        torch.ones(1 + episodes),
        1e-6,
    )
    at = minimise(problem, torch.zeros(1 + episodes), 30, lambda _: False)
    objective = SimpleNamespace(
        problem=lambda: problem,
        episodes=[SimpleNamespace(is_first_shape_measured=False)] * episodes,
        episode_of_rows=lambda linear: of_part,
        unknowns=[None],
        start=torch.zeros(1 + episodes),
        nuisances=[],
        cloth=SimpleNamespace(boundaries={}),
        blocks=[None],
        stated_noise=lambda block: 1.0,  # much larger than the residuals: no misfit
    )
    result = solution_covariance(objective, LinearityCheck(at, None, [], [])).diagonal().sqrt()
    alone = covariance(problem, at).diagonal().sqrt()
    assert result[1:] == pytest.approx(alone[1:])
    assert float(result[0]) > float(alone[0])
