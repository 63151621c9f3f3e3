"""The fused engine needs a compiler, or to have been built."""

import os

import pytest
import torch
from helpers import cuda_on_host

from torchcloth.engine import execution
from torchcloth.engine.library import library


@pytest.fixture(autouse=True, scope="module")
def _engine(request):
    """Build it once."""
    try:
        library()
    except RuntimeError as error:
        if "no C++ compiler" not in str(error):
            raise
        if request.path.name != "test_library.py":  # that file asks what happens then
            pytest.skip(str(error))


@pytest.fixture(autouse=True, scope="session")
def _stand_ins(tmp_path_factory):
    """Where programs for a device that are compiled here lie."""
    base = tmp_path_factory.getbasetemp()
    shared = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "stand-ins"
    shared.mkdir(exist_ok=True)
    cuda_on_host.BUILD_FOLDER[:] = [shared]


@pytest.fixture(params=[1, 3], ids=["alone", "team"])
def team(request, monkeypatch):
    """As many threads within one scene, however little there is to do for them."""
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    monkeypatch.setattr(execution, "MIN_OPS_PER_THREAD", 1e-9)
    yield request.param
    torch.set_num_threads(before)
