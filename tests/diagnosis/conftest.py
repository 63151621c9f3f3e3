"""Shared fixture: one base model."""

import pytest
from helpers import sheet_episodes
from helpers.twins import use_float64

from torchcloth.diagnosis import build_base_model, prepare_data


@pytest.fixture(scope="module")
def made():
    """The base model of ``sheet_episodes.make_episode()``, and its setting."""
    with use_float64():
        recording = sheet_episodes.make_episode()
        model = build_base_model(recording)
        return model, prepare_data(model, [recording])
