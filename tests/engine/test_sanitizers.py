"""Under `make test-sanitized` an access beyond memory ends the process: else that run could not fail."""

import os
import subprocess
import sys

import pytest

from torchcloth.engine import building

OUT_OF_BOUNDS = """
import torch
from torchcloth.engine.library import library
points, corners = torch.zeros(1000, 3).double(), torch.zeros(1, 3, 3).double()
triangles, weights = torch.zeros(1000).long(), torch.zeros(COUNT, 3).double()
pointers = points.data_ptr(), 1000, corners.data_ptr(), 1, triangles.data_ptr(), weights.data_ptr()
print("failed", library().tc_nearest_d(*pointers))
"""


@pytest.mark.skipif("sanitize" not in os.environ.get(building.EXTRA_FLAGS_VARIABLE, ""), reason="no sanitizers")
@pytest.mark.parametrize("count", [1000, 990])
def test_an_access_beyond_memory_ends_the_process(count):
    code = OUT_OF_BOUNDS.replace("COUNT", str(count))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    if count == 1000:
        assert done.stdout == "failed 0\n", done.stderr
    else:
        assert done.returncode
        assert "AddressSanitizer: heap-buffer-overflow" in done.stderr
