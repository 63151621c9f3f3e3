"""One diagnosis of full size, by the command: eight episodes of some 1.5 s, 392 triangles, drag hidden in them."""

import json
import subprocess
import sys
import time

import pytest

pytest.importorskip("mujoco", minversion="4.0")

from torchcloth.cli import main

GENERATE = "torchcloth.training.validation.independent.generate"

# motion, heading in degrees, speed
TAKES = (
    ("swing", 0, 1.6),
    ("swing-fast", 0, 0.8),
    ("swing", 90, 1.6),
    ("swing-fast", 90, 0.8),
    ("stretch", 0, 1.4),
    ("turn", 0, 1.8),
    ("hang", 0, 1.5),
    ("shake", 0, 1.3),
)
DRAG, SECONDS = 1.2, 900.0


@pytest.mark.slow
def test_eight_episodes_are_diagnosed_in_a_quarter_of_an_hour(tmp_path):
    """On two cores that do nothing else."""
    episodes = [tmp_path / f"e{k}" for k in range(len(TAKES))]
    for k, (path, (motion, heading, speed)) in enumerate(zip(episodes, TAKES, strict=True)):
        take = ["--motion", motion, "--heading", str(heading), "--speed", str(speed), "--seed", str(k)]
        mesh = ["--nodes", "21", "--fit-nodes", "15", "--effect", f"air.drag_n={DRAG}"]
        subprocess.run([sys.executable, "-m", GENERATE, *take, *mesh, "--out", path], check=True)
    began = time.monotonic()
    assert main(["diagnose", *map(str, episodes), "--out", str(tmp_path / "out")]) == 0
    assert time.monotonic() - began < SECONDS
    answer = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    (cause,) = answer["causes"]
    assert cause["effect"] == "air.drag_n"
    assert cause["amplitude"] == pytest.approx(DRAG, rel=0.1)
