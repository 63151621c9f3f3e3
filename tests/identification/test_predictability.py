"""Which beginning of an unstable motion is fitted: as long as the derivatives of all frames held."""

from types import SimpleNamespace

import pytest
import torch

from torchcloth.identification.estimators import levenberg_marquardt, linearity, predictability

FRAMES, ROWS_PER_FRAME = 40, 50


def failed_check(growth):
    """A check whose tangents are off by ``growth`` [FRAMES], relative to the slopes of every frame."""
    draw = torch.Generator().manual_seed(0)
    frame = torch.arange(FRAMES).repeat_interleave(ROWS_PER_FRAME)
    tangents = torch.randn(len(frame), 2, generator=draw, dtype=torch.float64)
    ones, sign = torch.ones(len(frame)).double(), torch.randn(len(frame), generator=draw).sign()
    secants = tangents * (1 + growth[frame] * sign)[:, None]
    linear = levenberg_marquardt.Linearised(ones, secants, ones, frame, 0 * frame)
    one = torch.ones(1, dtype=torch.float64)
    final = levenberg_marquardt.Iterate(torch.zeros(2).double(), linear, True, one, one, torch.inf * one)
    steps = linearity.FailedTangents(tangents, torch.ones(2).double())
    return linearity.LinearityCheck(final, None, [], [], "chaotic", None, steps)


@pytest.fixture
def objective():
    episode = SimpleNamespace(times=torch.arange(FRAMES) / 30.0, observed_count=FRAMES)
    return SimpleNamespace(episodes=[episode], episode_of_rows=lambda linear: torch.zeros_like(linear.frame))


def solver(asked, longest):
    def solve(objective, share, start, on_iterate, tolerance, settings):
        asked.append((share, tolerance))
        motion = SimpleNamespace(times=torch.arange(20) / 30.0, observed_count=20)
        final = levenberg_marquardt.Iterate(torch.tensor(share), *[None] * 5)
        checked = linearity.LinearityCheck(final, None, [], [])
        return (SimpleNamespace(episodes=[motion]), checked) if share < longest else None

    return solve


def test_derivatives_show_up_to_which_frame_they_held(objective):
    growth = torch.zeros(FRAMES).double()
    growth[20:] = 10.0
    assert predictability.find_predictable_fraction(objective, failed_check(growth), 0.25) == 0.5
    assert predictability.find_predictable_fraction(objective, failed_check(growth + 10), 0.25) == 0.0


def test_the_beginning_that_held_is_fitted_at_once(objective, monkeypatch):
    asked, growth = [], torch.zeros(FRAMES).double()
    growth[20:] = 10.0
    monkeypatch.setattr(predictability, "_solve_part", solver(asked, longest=1.0))
    fit = predictability.fit_predictable_part(objective, failed_check(growth), torch.tensor(0.0), lambda *_: False)
    assert asked == [(0.5, predictability.PREDICTABILITY_SETTINGS.final_tolerance)]
    assert "20 of 40, were used" in fit.checked.warnings[0]


def test_where_it_fails_shorter_beginnings_are_tried(objective, monkeypatch):
    asked, growth = [], torch.zeros(FRAMES).double()
    growth[20:] = 10.0
    monkeypatch.setattr(predictability, "_solve_part", solver(asked, longest=0.2))
    predictability.fit_predictable_part(objective, failed_check(growth), torch.tensor(0.0), lambda *_: False)
    assert [share for share, _ in asked] == pytest.approx([0.5, 0.1, 0.15, 0.22, 0.185, 0.2025, 0.185])
