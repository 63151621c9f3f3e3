"""The wheel of `make wheel` installs in an empty environment, and simulates there without a compiler."""

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SMOKE = Path(__file__).parent / "helpers" / "wheel_smoke.py"

pytestmark = [
    pytest.mark.slow,  # the engine is compiled twice, and PyTorch is installed
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="manylinux"),
    pytest.mark.skipif(shutil.which("make") is None or shutil.which("g++") is None, reason="needs make and g++"),
]


def run(*command: str | Path, **options) -> str:
    """Return the standard output of a command that must succeed."""
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True, **options)
    assert done.returncode == 0, f"{' '.join(map(str, command))}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """The wheel that `make wheel` leaves in dist/, made in a copy of the repository."""
    folder = tmp_path_factory.mktemp("source") / "torchcloth"
    for name in run("git", "ls-files", "-coz", "--exclude-standard", cwd=ROOT).split("\0"):
        if name and (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, folder / name)
    run("make", "wheel", f"PYTHON={sys.executable}", cwd=folder)
    (file,) = (folder / "dist").glob("*.whl")
    return file


@pytest.fixture(scope="module")
def empty_environment(wheel, tmp_path_factory) -> Path:
    """A new virtual environment with nothing but the wheel and what it requires."""
    folder = tmp_path_factory.mktemp("environment")
    run(sys.executable, "-m", "venv", folder)
    python = folder / "bin" / "python"
    run(python, "-m", "pip", "install", "--quiet", "--constraint", ROOT / "constraints.txt", "torch")
    run(python, "-m", "pip", "install", "--quiet", "--constraint", ROOT / "constraints.txt", wheel)
    return python


def test_the_wheel_is_for_this_platform_and_every_python(wheel):
    assert wheel.name.startswith("torchcloth-0.")
    assert "-py3-none-manylinux_2_" in wheel.name
    with zipfile.ZipFile(wheel) as archive:
        libraries = [name for name in archive.namelist() if re.match("torchcloth/engine/built/.", name)]
    assert libraries
    assert all(re.search(r"/engine-(x86-64-v\d|armv8-a)-[0-9a-f]{20}\.so$", name) for name in libraries)


def test_it_simulates_without_a_compiler(empty_environment, tmp_path):
    environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "CXX")}
    out = run(empty_environment, SMOKE, cwd=tmp_path, env=environment | {"OMP_NUM_THREADS": "1"})
    status, *_, last = out.strip().splitlines()
    assert status.startswith("portable: ")
    assert str(empty_environment.parents[1]) in status
    assert last == "ok"
