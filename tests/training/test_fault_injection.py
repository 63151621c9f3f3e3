"""Errors that are put into recordings are what they are called; of real swings the diagnosis says which (slow)."""

import io
import json

import numpy as np
import pytest

from torchcloth.training.studies import fault_injection
from torchcloth.training.studies.command import main
from torchcloth.training.studies.fault_injection import SALTS

EYE, MIDDLE = np.array([0.0, -1.3, 0.2]), np.array([0.1, 0.0, 0.3])
XYZ, T = MIDDLE + 0.1 * np.random.default_rng(0).standard_normal((50, 3)), np.linspace(0.0, 1.0, 10)


def put(label):
    return SALTS[label].put(XYZ, T, EYE, MIDDLE)


def test_stamps_are_later_and_points_where_they_were():
    """A clock that is late by -20 ms: frames were taken earlier than they say."""
    xyz, t = put("stamps 20 ms late")
    assert np.array_equal(xyz, XYZ)
    assert t - T == pytest.approx(0.02)
    assert SALTS["stamps 20 ms late"].amplitude == -0.02


def test_depths_grow_along_the_rays():
    xyz, t = put("depths 1 % too large")
    assert np.array_equal(t, T)
    assert np.linalg.norm(xyz - EYE, axis=1) == pytest.approx(1.01 * np.linalg.norm(XYZ - EYE, axis=1))
    assert np.cross(xyz - EYE, XYZ - EYE) == pytest.approx(0.0, abs=1e-12)


def test_a_camera_leans_about_the_cloths_middle():
    xyz, t = put("camera leans by 1 degree")
    assert np.array_equal(t, T)
    assert np.linalg.norm(xyz - MIDDLE, axis=1) == pytest.approx(np.linalg.norm(XYZ - MIDDLE, axis=1))
    assert xyz[:, 0] == pytest.approx(XYZ[:, 0])
    # to first order what the library's turn about +x by that angle does: a x r
    angle = SALTS["camera leans by 1 degree"].amplitude
    assert xyz - XYZ == pytest.approx(np.cross([angle, 0.0, 0.0], XYZ - MIDDLE), abs=angle**2 * 0.4)


def test_without_data_it_says_so(tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("TORCHCLOTH_REALDATA", raising=False)
    assert main(["salting", "--out", str(tmp_path / "s")]) == 2
    assert "set TORCHCLOTH_REALDATA" in capsys.readouterr().err
    assert not (tmp_path / "s").exists()


def test_what_diagnoses_say_is_told_beside_the_truth():
    from rich.console import Console

    clock = {"effect": "obs.clock", "amplitude": -0.021, "unit": "s", "ci95": [-0.025, -0.017], "class": ["obs.clock"]}
    air = {"effect": "air.linear", "amplitude": 2.8, "unit": "1/s", "ci95": [1.6, 4.0]}
    answers = {
        "plain": {"verdict": "unexplained", "causes": [], "given": []},
        "stamps 20 ms late": {
            "verdict": "ambiguous",
            "causes": [clock | {"rivals": [{"effect": "obs.extrinsic[z]"}]}],
            "given": [air],
        },
    }
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(fault_injection._blindly(answers))
    *_, plain, given, named = filter(str.strip, console.export_text().splitlines())
    assert "unexplained" in plain
    assert "air.linear (given)" in given
    assert "obs.clock -0.0200 s" in given  # the truth, beside what is said first
    assert "obs.extrinsic[z]" in named
    assert "-0.0210 (-0.0250 to -0.0170) s" in named


@pytest.mark.slow
@pytest.mark.realdata
def test_in_real_swings_they_are_found(measured_in, tmp_path, capsys):
    measured_in("iri_cloth_swings")
    assert main(["salting", "--out", str(tmp_path / "s")]) == 0
    found = json.loads((tmp_path / "s" / "salting.json").read_text())
    for case in found.values():
        assert case["fitted"] == pytest.approx(case["truth"]["amplitude"], abs=3 * case["std"])
    assert found["stamps 20 ms late"]["told"][0]["effect"] == "obs.clock"
    assert found["camera leans by 1 degree"]["told"][0]["effect"] == "obs.rotation[x]"
    # a shift along the rays and more depth of all of them are one where the cloth hardly comes nearer
    first = [row["effect"] for row in found["depths 1 % too large"]["told"]]
    assert set(first) == {"obs.depth_scale", "obs.depth_bias", "obs.extrinsic[y]"}
