"""Errors that are put into recordings are what they are called; of real swings the diagnosis says which (slow)."""

import io
import json

import numpy as np
import pytest

from torchcloth.training.studies import fault_injection
from torchcloth.training.studies.command import main
from torchcloth.training.studies.fault_injection import FAULTS

CAMERA_POSITION, CLOTH_CENTRE = np.array([0.0, -1.3, 0.2]), np.array([0.1, 0.0, 0.3])
XYZ, T = CLOTH_CENTRE + 0.1 * np.random.default_rng(0).standard_normal((50, 3)), np.linspace(0.0, 1.0, 10)


def inject(label):
    return FAULTS[label].inject(XYZ, T, CAMERA_POSITION, CLOTH_CENTRE)


def test_stamps_are_later_and_points_where_they_were():
    """A clock that is late by -20 ms: frames were taken earlier than they say."""
    xyz, t = inject("stamps 20 ms late")
    assert np.array_equal(xyz, XYZ)
    assert t - T == pytest.approx(0.02)
    assert FAULTS["stamps 20 ms late"].amplitude == -0.02


def test_depths_grow_along_the_rays():
    xyz, t = inject("depths 1 % too large")
    assert np.array_equal(t, T)
    assert np.linalg.norm(xyz - CAMERA_POSITION, axis=1) == pytest.approx(
        1.01 * np.linalg.norm(XYZ - CAMERA_POSITION, axis=1)
    )
    assert np.cross(xyz - CAMERA_POSITION, XYZ - CAMERA_POSITION) == pytest.approx(0.0, abs=1e-12)


def test_a_camera_leans_about_the_cloths_middle():
    xyz, t = inject("camera leans by 1 degree")
    assert np.array_equal(t, T)
    assert np.linalg.norm(xyz - CLOTH_CENTRE, axis=1) == pytest.approx(np.linalg.norm(XYZ - CLOTH_CENTRE, axis=1))
    assert xyz[:, 0] == pytest.approx(XYZ[:, 0])
    # to first order what the library's turn about +x by that angle does: a x r
    angle = FAULTS["camera leans by 1 degree"].amplitude
    assert xyz - XYZ == pytest.approx(np.cross([angle, 0.0, 0.0], XYZ - CLOTH_CENTRE), abs=angle**2 * 0.4)


def test_without_data_it_says_so(tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("TORCHCLOTH_REALDATA", raising=False)
    assert main(["fault_injection", "--out", str(tmp_path / "s")]) == 2
    assert "set TORCHCLOTH_REALDATA" in capsys.readouterr().err
    assert not (tmp_path / "s").exists()


def test_what_diagnoses_say_is_told_beside_the_truth():
    from rich.console import Console

    clock = {"effect": "obs.clock", "amplitude": -0.021, "unit": "s", "ci95": [-0.025, -0.017]}
    clock |= {"equivalence_class": ["obs.clock"]}
    air = {"effect": "air.linear", "amplitude": 2.8, "unit": "1/s", "ci95": [1.6, 4.0]}
    answers = {
        "plain": {"verdict": "unexplained", "causes": [], "initial_causes": []},
        "stamps 20 ms late": {
            "verdict": "ambiguous",
            "causes": [clock | {"rivals": [{"effect": "obs.extrinsic[z]"}]}],
            "initial_causes": [air],
        },
    }
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(fault_injection._blind_table(answers))
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
    assert main(["fault_injection", "--out", str(tmp_path / "s")]) == 0
    result = json.loads((tmp_path / "s" / "fault_injection.json").read_text())
    for case in (result[label] for label in FAULTS):
        assert case["fitted"] == pytest.approx(case["truth"]["amplitude"], abs=3 * case["std"])
    assert result["stamps 20 ms late"]["top_rows"][0]["effect"] == "obs.clock"
    assert result["camera leans by 1 degree"]["top_rows"][0]["effect"] == "obs.rotation[x]"
    # a shift along the rays and more depth of all of them are one where the cloth hardly comes nearer
    first = [row["effect"] for row in result["depths 1 % too large"]["top_rows"]]
    assert set(first) == {"obs.depth_scale", "obs.depth_bias", "obs.extrinsic[y]"}
