"""Two gloo processes on the CPU are one process with all their episodes."""

import json
import os
import socket
import subprocess
import sys

import pytest

pytest.importorskip("lightning")

from torchcloth.training.fit.command import main

pytestmark = pytest.mark.slow  # two processes of Lightning start up


def free_port() -> str:
    """Nobody listens there."""
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return str(sock.getsockname()[1])


def test_two_processes_are_one(config, episodes, tmp_path):
    """Three episodes do not divide by two, one validation episode is fewer than processes: means stay exact."""
    path = config(data={"train": str(episodes / "ep_*"), "val": str(episodes / "held")}, optimizer={"steps": 2})
    environment = {**os.environ, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": free_port(), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "torchcloth.training.fit", "--config", path]
    overrides = ["run.processes=2", f"out={tmp_path / 'two'}"]
    done = subprocess.run(
        command + overrides, env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert main(["--config", path]) == 0
    one, two = (json.loads((tmp_path / name / "fit.json").read_text()) for name in ("out", "two"))
    assert (one["processes"], two["processes"]) == (1, 2)
    for name, parameter in one["parameters"].items():
        assert two["parameters"][name]["value"] == pytest.approx(parameter["value"], rel=1e-6)
        assert parameter["value"] != pytest.approx(parameter["initial"], rel=1e-2)
    for kind in ("train", "val"):
        for figure, value in one[kind].items():
            assert two[kind][figure] == pytest.approx(value, rel=1e-6)
    for before, after in zip(one["history"], two["history"], strict=True):
        assert after == pytest.approx(before, rel=1e-6)
