"""Drifts of forces on linear toys: what all motions share is seen, what depends on the motion is not."""

from dataclasses import replace

import linear_toys as toys
import pytest
import torch

from torchcloth.diagnosis import drifts
from torchcloth.diagnosis.cells import NAMES, SEEN
from torchcloth.diagnosis.lacking import SENSOR
from torchcloth.diagnosis.noise import Noise

TARE = 0.1  # N
SLOPES = torch.zeros(toys.EPISODES, len(toys.grid().value), 2).double()
SLOPES[..., 1] = (toys.grid().patch // 3 % 3 == 2).double()  # what differs from episode to episode: forces along z


def evidence(seed, *rates):
    """Forces of five grippers and one axis more in each episode, which grow along z by a rate [N/s] for each."""
    rng = torch.Generator().manual_seed(seed)
    blank = toys.evidence(SLOPES, 1, [], torch.zeros(1).double(), seed)
    level = torch.tensor([SENSOR[name] for name in NAMES]).double()
    cells, std = [], torch.tensor([TARE]).double()
    for c, rate in zip(blank.cells, rates, strict=False):
        c = c._replace(block=torch.full_like(c.block, SEEN), patch=c.patch // 3)
        root = torch.linalg.cholesky(Noise(level).covariance(c, c.jacobian[:, -1:], std))
        noise = root @ torch.randn(len(root), generator=rng).double()
        cells.append(c._replace(value=noise + rate * c.time * (c.patch % 3 == 2)))
    return replace(blank, cells=cells, stds=[std] * len(cells), numerics=blank.numerics[: len(cells)])


def told(seed, *rates):
    return drifts(toys.fitted(evidence(seed, *rates)))


def test_a_right_model_drifts_by_chance_as_often_as_it_says():
    rows = [row for seed in range(60) for row in told(seed, *[0.0] * toys.EPISODES)]
    size = torch.tensor([row.rate / row.std for row in rows])
    assert 0.7 < float(size.square().mean()) < 1.1  # what episodes differ by makes it a little careful
    assert sum(row.lacking for row in rows) <= 2


def test_what_all_motions_share_is_seen_though_none_shows_it():
    x, y, z = told(0, *[-0.03] * toys.EPISODES)
    assert [row.lacking for row in (x, y, z)] == [False, False, True]
    assert z.rate == pytest.approx(-0.03, abs=3 * z.std)
    assert z.std * toys.EPISODES**0.5 > 0.3 * 0.03  # two or three standard errors in each


def test_what_depends_on_the_motion_is_no_drift():
    assert not any(row.lacking for row in told(0, 0.2, -0.1, 0.1, -0.05))


def test_two_episodes_may_be_alike_by_chance():
    assert told(0, 0.2, 0.2) == []


def test_without_forces_nothing_is_said():
    assert drifts(toys.fitted(toys.evidence(SLOPES, 1, [], torch.zeros(1).double(), 0))) == []
