"""The table for a device: refused in one line where there is none, and made by what a CPU has of its paths."""

import sys
from functools import partial

import pytest
import torch

from torchcloth.benchmarks import devices


def run(monkeypatch, *words: str) -> None:
    monkeypatch.setattr(sys, "argv", ["devices", *words])
    devices.main()


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a device")
def test_without_a_device_it_says_so(monkeypatch, capsys):
    with pytest.raises(SystemExit, match="2"):
        run(monkeypatch)
    assert "got no CUDA device, expected one" in capsys.readouterr().err


def test_no_scenes_are_refused(monkeypatch, capsys):
    with pytest.raises(SystemExit, match="2"):
        run(monkeypatch, "--scenes", "4", "0")
    assert "--scenes: got 0, expected 1 or more" in capsys.readouterr().err


@pytest.mark.parametrize("how", ["--contact", "--folded"])
def test_paths_agree_and_are_listed(monkeypatch, capsys, how):
    paths = {
        "fused, CPU": devices.SimulationPath("cpu", "fused"),
        "one by one": devices.SimulationPath("cpu", "reference"),
    }
    monkeypatch.setattr(devices, "PATHS", paths)
    monkeypatch.setattr(devices, "sheet", partial(devices.sheet, cells=8))  # the reference takes minutes for more
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "none")
    run(monkeypatch, "--scenes", "2", how, "--frames", "1", "--repeats", "1")
    rows = [line.split("|")[1:3] for line in capsys.readouterr().out.splitlines() if line.startswith("| 2")]
    assert [[cell.strip() for cell in row] for row in rows] == [["2", "fused, CPU"], ["2", "one by one"]]
