"""The command line as a process, and what it says when it refuses."""

import os
import subprocess
import sys
from pathlib import Path

from helpers.twins import make_twin, take_first_frames, use_float64
from torchcloth import recordings
from torchcloth.cli import main

COMMAND = [sys.executable, "-m", "torchcloth.cli"]
QUICK_FIT = ["--fit", "youngs_modulus", "air.normal", "--exact-bench"]
ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "1", "COLUMNS": "80", "PYTHONUNBUFFERED": "1"}


def call(*arguments, **options):
    """Run the command in a process of its own."""
    return subprocess.run(
        [*COMMAND, *map(str, arguments)], capture_output=True, text=True, env=ENVIRONMENT, timeout=300, **options
    )


def write_twin(folder: Path) -> Path:
    """Write the first frames of the twin episode, and return the folder."""
    with use_float64():
        return recordings.write(take_first_frames(make_twin(), 8), folder)


def one_line(text):
    """Check that a text is one line of the command, and return it."""
    assert text.endswith("\n")
    assert text.count("\n") == 1, text
    assert text.startswith("torchcloth: ")
    assert "Traceback" not in text
    return text


def refuse(capsys, out, *arguments):
    """What stderr says when ``main`` refuses; nothing may be left behind."""
    code = main([str(a) for a in arguments] + ["--out", str(out)])
    said = one_line(capsys.readouterr().err)
    assert code == 2
    assert not out.exists() or list(out.iterdir()) == [], "something was written into a fresh --out"
    return said
