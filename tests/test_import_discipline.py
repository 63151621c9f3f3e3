"""``import torchcloth`` costs little more than ``import torch``; heavy packages are imported where they are used."""

import json
import os
import subprocess
import sys

import pytest

HEAVY = (
    "av",
    "jsonschema",
    "lightning",
    "matplotlib",
    "mujoco",
    "open3d",
    "pyarrow",
    "pytorch_kinematics",
    "pytorch_lightning",
    "rich",
    "rosbags",
    "scipy",
    "trimesh",
    "yourdfpy",
)
ALLOWED = 0.5  # s of the processor beyond torch; the package takes about 0.1 s, 0.25 where no bytecode is kept

IMPORT = """
import json, sys, time
import torch
before, start = set(sys.modules), time.process_time()
import torchcloth
print(json.dumps({"seconds": time.process_time() - start, "modules": sorted(set(sys.modules) - before)}))
"""


def run(code: str) -> str:
    """Standard output of ``code`` in a fresh interpreter."""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"}
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def imports() -> list[dict]:
    """Seconds and new modules of ``import torchcloth``, twice."""
    return [json.loads(run(IMPORT)) for _ in range(2)]


def test_nothing_heavy_is_imported(imports):
    loaded = {module.partition(".")[0] for module in imports[0]["modules"]}
    assert "torchcloth" in loaded
    assert not loaded & set(HEAVY)


def test_import_is_quick(imports):
    seconds = min(found["seconds"] for found in imports)
    assert seconds < ALLOWED, f"import torchcloth took {seconds:.2f} s beyond torch"


def test_companions_come_with_the_package():
    """``import torchcloth as tc`` is the only import that a user needs, and packages do not pull heavy packages either.

    The lazy lookup answers as a module does, so that ``hasattr`` and misspellings work.
    """
    loaded = f"sorted(m for m in {HEAVY} if m in sys.modules)"
    found = "callable(tc.robots.load), callable(tc.recordings.read), hasattr(tc, 'robotz')"
    out = run(f"import sys, torchcloth as tc; print({found}, *{loaded})")
    assert out.split() == ["True", "True", "False"]
