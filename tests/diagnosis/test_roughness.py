"""Roughness: without it, a fit of rippling cloth stops where a small step changes the ripples."""

import math
from dataclasses import replace

import pytest
import torch
from helpers import linear_evidence as toys

from torchcloth.diagnosis.decide.criteria import CRITERIA
from torchcloth.diagnosis.inference import fitting, noise
from torchcloth.diagnosis.inference.fitting import fit
from torchcloth.diagnosis.inference.linearise import Linearisation, central_differences

TRUTH, STEP = 0.3, 0.1
RIPPLES, LENGTH = 2e-3, 0.15  # m, of ripples that come and go within so much of the parameter
SMOOTH = toys.draw_jacobian(3, 2)


@pytest.fixture
def rippling(monkeypatch):
    """A model of one parameter; in a third of each episode ripples hide what it does."""
    there = toys.make_model_fit(toys.draw_linearisation(SMOOTH, 1, [], torch.tensor([TRUTH]).double(), 0))
    rng, size = torch.Generator().manual_seed(4), len(toys.make_cells().value)
    phases, real = (
        2 * math.pi * torch.rand(2, toys.EPISODE_COUNT, size, generator=rng)
    )  # real cloth has ripples of its own

    def seen(k, at):
        cells = there.linearisation.bins[k]
        ripples = RIPPLES * (torch.sin(2 * math.pi * at / LENGTH + phases[k]) - torch.sin(real[k]))
        return cells.value + cells.jacobian[:, 0] * at + torch.where(cells.window >= 4, ripples.double(), 0.0)

    def gather(model, setting, hypotheses, progress, before) -> Linearisation:
        at, cells = float(model.point[0]), []
        for k, c in enumerate(there.linearisation.bins):
            down, here, up = (seen(k, at + step) for step in (-STEP, 0.0, STEP))
            sides = torch.stack([(up - here) / STEP, (here - down) / STEP], 1)
            sided = c._replace(value=here, jacobian=torch.cat([sides, c.jacobian[:, 1:]], 1))
            cells.append(central_differences(sided, [(0, STEP), (0, -STEP)], 1))
        return replace(there.linearisation, bins=cells)

    monkeypatch.setattr(fitting, "linearise", gather)
    return there.model


def test_a_fit_goes_on_where_ripples_change(rippling):
    found = fit(rippling, None, iterations=8)  # type: ignore[arg-type]
    assert abs(float(found.model.point[0]) - TRUTH) < 3 * float(found.covariance[0, 0]) ** 0.5


def test_without_roughness_it_stays(rippling, monkeypatch):
    without_roughness = replace(CRITERIA.noise, roughness_steps=0.0)
    monkeypatch.setattr(noise, "CRITERIA", replace(CRITERIA, noise=without_roughness))
    found = fit(rippling, None, iterations=8)  # type: ignore[arg-type]
    assert abs(float(found.model.point[0]) - TRUTH) > 4 * float(found.covariance[0, 0]) ** 0.5
