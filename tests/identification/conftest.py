"""One twin episode, and one fit of it, for all tests of this folder."""

import pytest
from helpers import twins

from torchcloth.identification import identify


@pytest.fixture(scope="session")
def recording():
    with twins.doubles():
        return twins.twin()


@pytest.fixture(scope="session")
def brief(recording):
    """Its first six frames."""
    return twins.first(recording, 6)


@pytest.fixture
def model(recording):
    """The start: the data sheet's values, twice the true stiffness."""
    return twins.at(recording)


@pytest.fixture(scope="session")
def one_step(recording, brief):
    """A step of the brief episode's stiffness, from the data sheet's."""
    with twins.doubles():
        return identify(twins.at(recording), brief, ["youngs_modulus"], iterations=1)


@pytest.fixture(scope="session")
def plain(recording):
    """Stiffness and air only, from the data sheet's values."""
    with twins.doubles():
        return identify(twins.at(recording), recording, ["youngs_modulus", "air.normal"])


@pytest.fixture(scope="session")
def fitted(recording):
    """(result, what on_progress was called with): everything the model contains, from the data sheet's values."""
    calls = []
    with twins.doubles():
        return identify(twins.at(recording), recording, on_progress=lambda *call: calls.append(call)), calls


@pytest.fixture(scope="session")
def pair(recording):
    """Stiffness and air only, from 20 N/m: half the true stiffness, a quarter of the data sheet's."""
    with twins.doubles():
        return identify(twins.at(recording, youngs_modulus=2e4), recording, ["youngs_modulus", "air.normal"])
