"""One occluded twin episode, and estimates from it, for all tests of this folder."""

import pytest
from helpers import occluded_twins, twins

from torchcloth.pose import estimate_pose

SMALL = {"modes": 4, "window": 0.18}


@pytest.fixture(scope="session")
def scene():
    """The recording, and where the fit's vertices truly were [T, V, 3] m."""
    with twins.use_float64():
        return occluded_twins.make_occluded_twin()


@pytest.fixture(scope="session")
def right(scene):
    """With the true values."""
    with twins.use_float64():
        return estimate_pose(occluded_twins.build_cloth(scene, twins.TRUE_FABRIC), scene.recording, **SMALL)


@pytest.fixture(scope="session")
def wrong(scene):
    """Half the stiffness and half the drag, taken as exact."""
    with twins.use_float64():
        return estimate_pose(occluded_twins.build_cloth(scene, occluded_twins.WRONG_FABRIC), scene.recording, **SMALL)
