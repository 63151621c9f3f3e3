"""Shared settings: one thread (the meshes are small), float64 physics."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

torch.set_num_threads(1)


@pytest.hookimpl(trylast=True)  # once it is known which are left out
def pytest_collection_modifyitems(items):
    """What takes longest comes first: at the end one of the workers would wait for it.

    Each of the three that `make test` has begins with a third of the tests as they stand here: one with the notebooks,
    one with the hidden round.
    """
    of = lambda name: [item for item in items if item.path.name == name]  # noqa: E731
    first, second = of("test_notebooks.py"), of("test_hidden_round.py")
    others = [item for item in items if item not in (*first, *second)]
    head = max(0, len(items) // 3 + 1 - len(first))
    items[:] = [*first, *others[:head], *second, *others[head:]]


@pytest.fixture(autouse=True)
def _float64():
    """Physics is verified in float64; tests of float32 set it themselves. What is drawn is drawn alike every time."""
    torch.manual_seed(0)
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


@pytest.fixture(scope="session")
def realdata() -> Path:
    """Folder of measured data; skips where none is named."""
    folder = os.environ.get("TORCHCLOTH_REALDATA")
    if not folder:
        pytest.skip("TORCHCLOTH_REALDATA does not name a folder of measured data")
    assert Path(folder).is_dir(), f"TORCHCLOTH_REALDATA: {folder} is no folder"
    return Path(folder)


@pytest.fixture(scope="session")
def measured_in(realdata: Path) -> Callable[[str], Path]:
    """The folder of a source by name; skips where it is absent."""

    def find(name: str) -> Path:
        if not (realdata / name).is_dir():
            pytest.skip(f"{realdata / name} is absent")
        return realdata / name

    return find
