import numpy as np
import pytest

from torchcloth.errors import MissingDependency
from torchcloth.observe import render_depth


@pytest.fixture(scope="session")
def render():
    """render_depth, or a skip where open3d (or the libusb it loads) is not installed."""
    from torchcloth.observe import DepthCamera

    try:
        render_depth(DepthCamera(1, 1, np.eye(3), np.eye(4)), [])
    except MissingDependency as error:
        pytest.skip(str(error))
    return render_depth


@pytest.fixture
def rectangle():
    """A rectangle [0, w] x [0, h] at depth z, in the camera's own axes."""

    def make(x0, x1, y0, y1, z, tilt=0.0):
        vertices = np.array([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]], float)
        vertices[:, 2] += tilt * vertices[:, 0]
        return vertices, np.array([[0, 1, 2], [0, 2, 3]])

    return make
