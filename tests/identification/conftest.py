"""One twin episode, and one fit of it, for all tests of this folder."""

import pytest
from helpers import twins

from torchcloth.identification import identify


@pytest.fixture(scope="session")
def recording():
    with twins.use_float64():
        return twins.make_twin()


@pytest.fixture(scope="session")
def brief(recording):
    """Its first six frames."""
    return twins.take_first_frames(recording, 6)


@pytest.fixture
def model(recording):
    """The start: the data sheet's values, twice the true stiffness."""
    return twins.build_cloth_at(recording)


@pytest.fixture(scope="session")
def one_step(recording, brief):
    """A step of the brief episode's stiffness, from the data sheet's."""
    with twins.use_float64():
        return identify(twins.build_cloth_at(recording), brief, ["youngs_modulus"], iterations=1, exact_bench=True)


@pytest.fixture(scope="session")
def plain(recording):
    """Stiffness and air only, from the data sheet's values."""
    with twins.use_float64():
        return identify(twins.build_cloth_at(recording), recording, ["youngs_modulus", "air.normal"], exact_bench=True)


@pytest.fixture(scope="session")
def fitted(recording):
    """(result, what on_progress was called with): everything the model contains, from the data sheet's values."""
    calls = []
    with twins.use_float64():
        return identify(
            twins.build_cloth_at(recording), recording, on_progress=lambda *call: calls.append(call), exact_bench=True
        ), calls


@pytest.fixture(scope="session")
def pair(recording):
    """Stiffness and air only, from 20 N/m: half the true stiffness, a quarter of the data sheet's."""
    with twins.use_float64():
        return identify(
            twins.build_cloth_at(recording, youngs_modulus=2e4),
            recording,
            ["youngs_modulus", "air.normal"],
            model_errors=twins.SAME_SIMULATOR,
            exact_bench=True,
        )
