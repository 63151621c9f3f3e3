"""Shared fixtures: float64, and one base model."""

import pytest
import torch


@pytest.fixture(autouse=True)
def _doubles():
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(before)


@pytest.fixture(scope="module")
def made():
    """The base model of ``sheets.episode()``, and its setting."""
    from helpers import sheet_episodes

    from torchcloth.diagnosis import build_base_model, prepare_data

    before, recording = torch.get_default_dtype(), sheet_episodes.make_episode()
    torch.set_default_dtype(torch.float64)
    model = build_base_model(recording)
    yield model, prepare_data(model, [recording])
    torch.set_default_dtype(before)
