import pytest

from torchcloth.errors import MissingDependency
from torchcloth.observe.render import open3d_or_refuse


@pytest.fixture(scope="session")
def needs_open3d():
    try:
        open3d_or_refuse()
    except MissingDependency as error:
        pytest.skip(str(error))
