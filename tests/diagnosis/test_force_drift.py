"""Force drift on linear examples: a drift that all motions share is found, one that depends on the motion is not."""

from dataclasses import replace

import pytest
import torch
from helpers import linear_evidence as toys
from scipy.stats import t as student

from torchcloth.diagnosis import estimate_force_drifts
from torchcloth.diagnosis.data.binning import BLOCK_NAMES, FORCE_BLOCK
from torchcloth.diagnosis.decide.criteria import CRITERIA
from torchcloth.diagnosis.inference.force_drift import _pool_motions
from torchcloth.diagnosis.inference.noise import Noise

TARE = 0.1  # N
SLOPES = torch.zeros(toys.EPISODE_COUNT, len(toys.make_cells().value), 2).double()
SLOPES[..., 1] = (
    toys.make_cells().channel // 3 % 3 == 2
).double()  # what differs from episode to episode: forces along z


def evidence(seed, *rates):
    """Forces of five grippers and one axis more in each episode, which grow along z by a rate [N/s] for each."""
    rng = torch.Generator().manual_seed(seed)
    blank = toys.draw_linearisation(SLOPES, 1, [], torch.zeros(1).double(), seed)
    level = torch.tensor([CRITERIA.adequacy.sensor_error[name] for name in BLOCK_NAMES]).double()
    cells, std = [], torch.tensor([TARE]).double()
    for c, rate in zip(blank.bins, rates, strict=False):
        c = c._replace(block=torch.full_like(c.block, FORCE_BLOCK), channel=c.channel // 3)
        root = torch.linalg.cholesky(Noise(level).covariance(c, c.jacobian[:, -1:], std))
        noise = root @ torch.randn(len(root), generator=rng).double()
        cells.append(c._replace(value=noise + rate * c.time * (c.channel % 3 == 2)))
    return replace(
        blank, bins=cells, nuisance_stds=[std] * len(cells), mesh_differences=blank.mesh_differences[: len(cells)]
    )


def told(seed, *rates, names="abcd"):
    return estimate_force_drifts(toys.make_model_fit(evidence(seed, *rates)), names)


def test_an_axis_of_which_too_few_motions_know_is_left_out():
    """Cells of one axis may all jump, or all of an episode."""
    whole = evidence(3, *[0.1] * toys.EPISODE_COUNT)

    def less(c, keep):
        return type(c)(*(column[keep] for column in c))

    cells = [less(c, c.channel % 3 != 0) for c in whole.bins]
    some = _of(whole, cells)
    assert [row.axis for row in some] == ["y", "z"]
    cells = [less(c, torch.zeros(len(c.time), dtype=torch.bool)) if k == 0 else c for k, c in enumerate(whole.bins)]
    assert _of(whole, cells) == [], "three motions are too few"


def _of(evidence, cells):
    numerics = [n[: len(c.value)] for n, c in zip(evidence.mesh_differences, cells, strict=True)]
    return estimate_force_drifts(
        toys.make_model_fit(replace(evidence, bins=cells, mesh_differences=numerics)), range(toys.EPISODE_COUNT)
    )


def test_a_right_model_drifts_by_chance_as_often_as_it_says():
    rows = [row for seed in range(60) for row in told(seed, *[0.0] * toys.EPISODE_COUNT)]
    size = torch.tensor([row.rate / row.std for row in rows])
    assert 0.7 < float(size.square().mean()) < 1.1  # what episodes differ by makes it a little careful
    assert sum(row.is_significant for row in rows) <= 2


def test_what_all_motions_share_is_seen_though_none_shows_it():
    x, y, z = told(0, *[-0.03] * toys.EPISODE_COUNT)
    assert [row.is_significant for row in (x, y, z)] == [False, False, True]
    assert z.rate == pytest.approx(-0.03, abs=3 * z.std)
    assert z.std * toys.EPISODE_COUNT**0.5 > 0.3 * 0.03  # two or three standard errors in each


def test_what_depends_on_the_motion_is_no_drift():
    assert not any(row.is_significant for row in told(0, 0.2, -0.1, 0.1, -0.05))


@pytest.mark.parametrize("spread", [0.0, 1.0, 3.0, 10.0])
def test_motions_that_differ_at_random_seldom_pass_for_alike(spread):
    """Of six; what they differ by is in units of what each is known to."""
    rng = torch.Generator().manual_seed(0)
    known = 0.6 * torch.rand(2000, 6, generator=rng).double() + 0.7
    rates = torch.randn(2000, 6, generator=rng).double() * (known + spread**2).sqrt()
    pooled = [_pool_motions(rate, variance) for rate, variance in zip(rates, known, strict=True)]
    chances = [3 * 2 * student.sf(abs(mean) / std, freedom) for mean, std, freedom in pooled]
    assert sum(p < 0.01 for p in chances) / 2000 < 0.02  # a normal distribution: 0.03 and more where they differ much


def test_three_motions_may_be_alike_by_chance():
    assert told(0, 0.2, 0.2, 0.2, names="abc") == []


def test_repetitions_of_a_motion_are_no_other_motions():
    assert told(0, *[-0.03] * toys.EPISODE_COUNT, names="abca") == []


def test_where_meshes_fold_apart_no_force_is_judged():
    ev = evidence(0, *[-0.03] * toys.EPISODE_COUNT)
    seen = replace(ev, bins=[c._replace(block=torch.where(c.window == 0, 0, c.block)) for c in ev.bins])
    assert estimate_force_drifts(toys.make_model_fit(seen), "abcd") != []
    apart = replace(seen, mesh_differences=[torch.full_like(n, 1.0) for n in ev.mesh_differences])
    assert estimate_force_drifts(toys.make_model_fit(apart), "abcd") == []


def test_without_forces_nothing_is_said():
    assert (
        estimate_force_drifts(
            toys.make_model_fit(toys.draw_linearisation(SLOPES, 1, [], torch.zeros(1).double(), 0)), "abcd"
        )
        == []
    )
