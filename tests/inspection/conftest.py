import pytest

from torchcloth.errors import MissingDependency
from torchcloth.observe.render import import_open3d


@pytest.fixture(scope="session")
def needs_open3d():
    try:
        import_open3d()
    except MissingDependency as error:
        pytest.skip(str(error))
