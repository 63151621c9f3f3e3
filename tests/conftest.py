"""Shared settings: one thread (the meshes are small), float64 physics."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

torch.set_num_threads(1)


WORKERS = 3  # of `make test`; each begins with a third of the tests
LONGEST_FILES = ("test_hidden_round.py", "test_diagnose.py", "test_resuming.py", "test_demo.py", "test_notebooks.py")

# Files whose tests take about a second each or more; `make test-fast` leaves them out.
LONG_FILES = frozenset(
    [
        "test_hidden_round.py",
        "test_diagnose.py",
        "test_resuming.py",
        "test_demo.py",
        "test_notebooks.py",
        "test_boundaries.py",
        "test_plan.py",
        "test_levenberg_marquardt.py",
        "test_diffcp_sample.py",
        "test_fabrics.py",
        "test_docs_code.py",
        "test_import_discipline.py",
        "test_inspect.py",
        "test_cli.py",
        "test_suite.py",
        "test_device.py",
        "test_nylon.py",
        "test_replan_episode.py",
        "test_effects.py",
        "test_statistics.py",
        "test_contact.py",
        "test_posterior_samples.py",
        "test_nuisances.py",
        "test_packaging.py",
        "test_replicates.py",
        "test_cases.py",
        "test_fit.py",
        "test_ablation.py",
        "test_metrics.py",
        "test_estimate.py",
        "test_tension.py",
        "test_library.py",
        "test_fuzz.py",
        "test_ablations.py",
        "test_fuzz_formats.py",
        "test_loading.py",
    ]
)


def pytest_itemcollected(item):
    """Mark the tests of long files."""
    if item.path.name in LONG_FILES:
        item.add_marker("long")


@pytest.hookimpl(trylast=True)  # after deselection
def pytest_collection_modifyitems(items):
    """Let each worker begin with long tests, so that none waits for another at the end."""
    long = {name: [item for item in items if item.path.name == name] for name in LONGEST_FILES}
    others = [item for item in items if item.path.name not in long]
    share = len(others) // WORKERS + 1
    items[:] = [
        item
        for worker in range(WORKERS)
        for group in (*list(long.values())[worker::WORKERS], others[worker * share : (worker + 1) * share])
        for item in group
    ]


@pytest.fixture(autouse=True)
def _float64():
    """Verify physics in float64, with a fixed seed; tests of float32 set it themselves."""
    torch.manual_seed(0)
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


@pytest.fixture(scope="session")
def realdata() -> Path:
    """Return the folder of measured data; skip where none is named."""
    folder = os.environ.get("TORCHCLOTH_REALDATA")
    if not folder:
        pytest.skip("TORCHCLOTH_REALDATA does not name a folder of measured data")
    assert Path(folder).is_dir(), f"TORCHCLOTH_REALDATA: {folder} is no folder"
    return Path(folder)


@pytest.fixture(scope="session")
def measured_in(realdata: Path) -> Callable[[str], Path]:
    """Return a function that finds the folder of a source by name, and skips where it is absent."""

    def find(name: str) -> Path:
        if not (realdata / name).is_dir():
            pytest.skip(f"{realdata / name} is absent")
        return realdata / name

    return find
