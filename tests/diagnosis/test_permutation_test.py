"""Permutation test on linear examples: real causes pass, and others pass as rarely as the level says."""

from dataclasses import replace

import pytest
import torch
from helpers import linear_evidence as toys

from torchcloth.diagnosis.inference.fitting import robust_step
from torchcloth.diagnosis.inference.permutation_test import run_permutation_test
from torchcloth.diagnosis.inference.robust_weights import reweight

SLOPES = toys.draw_jacobian(1, 4)  # two parameters, a cause, a nuisance
MOTIONS = [f"motion {k}" for k in range(toys.EPISODE_COUNT)]


def with_cause(amplitude: float, seed: int, slopes=SLOPES):
    """A fitted model with the cause, of data that have so much of it."""
    ev = toys.draw_linearisation(slopes, 3, [], torch.tensor([0.1, -0.1, amplitude]).double(), seed)
    found = toys.make_model_fit(ev)
    model = replace(found.model, parameters=found.model.parameters[:2], coordinates=found.model.coordinates[:2])
    model = model.with_hypothesis(toys.make_hypothesis("cause"))
    step, _ = robust_step(found.whitened, model)
    there = found.whitened._replace(value=found.whitened.value + found.whitened.jacobian[:, :3] @ step)
    return replace(found, model=model.at_point(step), whitened=reweight(there))


def test_a_cause_beats_its_placebos():
    for seed in range(5):
        found = run_permutation_test(with_cause(0.5, seed), MOTIONS, seed=seed)
        assert found.is_passed
        assert found.gain > 20 + 5 * max(found.quantile_95, 0.0)


@pytest.mark.slow
def test_what_is_not_there_seldom_does():
    """Of 30 data without the cause some 5 % may pass by chance: 6 or more would happen once in 300 times."""
    passed = sum(run_permutation_test(with_cause(0.0, seed), MOTIONS, seed=seed).is_passed for seed in range(30))
    assert passed < 6


def test_the_same_seed_gives_the_same_placebos():
    found = with_cause(0.0, 1)
    assert run_permutation_test(found, MOTIONS, seed=3) == run_permutation_test(found, MOTIONS, seed=3)


def test_what_is_alike_everywhere_is_no_placebo_of_itself():
    """A camera that stands elsewhere: exchanged between windows and motions it was the cause, and passed by chance."""
    for share in (0.0, 0.03):  # by which windows differ
        rng = torch.Generator().manual_seed(5)
        steady = SLOPES.clone()
        windows = 1 - share * torch.rand(toys.EPISODE_COUNT, toys.WINDOW_COUNT, generator=rng).double()
        steady[..., 2] = 4e-3 * windows[:, toys.make_cells().window]
        assert all(
            run_permutation_test(with_cause(1.0, seed, steady), MOTIONS, seed=seed).is_passed for seed in range(6)
        )
