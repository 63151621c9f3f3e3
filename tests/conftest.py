"""Shared settings: one thread (the meshes are small), float64 physics."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

torch.set_num_threads(1)


# Files that take longest, in this order. Workers begin with them, so that none waits for another at the end, and
# `make test-fast` leaves them out.
LONG_FILES = (
    "test_docs_code.py",
    "test_command.py",
    "test_boundaries.py",
    "test_demo.py",
    "test_honesty.py",
    "test_diagnose.py",
    "test_effects.py",
    "test_noise_screening_comparison.py",
    "test_plan.py",
    "test_inspect.py",
    "test_levenberg_marquardt.py",
    "test_device.py",
    "test_loading.py",
    "test_estimate.py",
    "test_contact.py",
    "test_replicates.py",
    "test_fuzz.py",
    "test_fuzz_formats.py",
    "test_cases.py",
    "test_data_checks.py",
    "test_library.py",
    "test_missing_force.py",
    "test_packaging.py",
    "test_tension_prediction.py",
    "test_posterior_samples.py",
    "test_suite.py",
    "test_fit.py",
    "test_force_terms.py",
    "test_nuisances.py",
    "test_identify.py",
    "test_import_discipline.py",
    "test_proposal.py",
    "test_metrics.py",
    "test_hypotheses.py",
    "test_operators.py",
    "test_blocks.py",
    "test_convergence.py",
    "test_garment_studies.py",
    "test_simulate.py",
    "test_dynamics.py",
    "test_nylon.py",
    "test_tension.py",
    "test_ablation.py",
    "test_ablations.py",
    "test_search.py",
)


def pytest_itemcollected(item):
    """Mark the tests of long files."""
    if item.path.name in LONG_FILES:
        item.add_marker("long")


@pytest.hookimpl(trylast=True)  # after deselection
def pytest_collection_modifyitems(items):
    """Put the longest files first; the order within a file stays."""
    rank = {name: number for number, name in enumerate(LONG_FILES)}
    items.sort(key=lambda item: rank.get(item.path.name, len(rank)))


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
