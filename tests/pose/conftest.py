"""One occluded twin episode, and estimates from it, for all tests of this folder."""

import pytest
from helpers import occluded_twins, twins

from torchcloth.pose import estimate_pose

SMALL = {"modes": 4, "window": 0.18}


@pytest.fixture(scope="session")
def scene():
    """The recording, and where the fit's vertices truly were [T, V, 3] m."""
    with twins.doubles():
        return occluded_twins.twin()


@pytest.fixture(scope="session")
def right(scene):
    """With the true values."""
    with twins.doubles():
        return estimate_pose(occluded_twins.model(scene, twins.TRUE), scene.recording, **SMALL)


@pytest.fixture(scope="session")
def wrong(scene):
    """Half the stiffness and half the drag, taken as exact."""
    with twins.doubles():
        return estimate_pose(occluded_twins.model(scene, occluded_twins.WRONG), scene.recording, **SMALL)
