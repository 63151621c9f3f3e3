"""The study of measured cloth: its fast version on the data, and refusals without them."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

from torchcloth.errors import InvalidInput
from torchcloth.identification import read_tension_model
from torchcloth.recordings import ForceDisplacement
from torchcloth.training.studies.command import main
from torchcloth.training.studies.measured import SOURCE_NAMES, find_data_folder, swing_predictions, swings, tension
from torchcloth.training.validation.realdata import free_swing


@pytest.mark.slow
@pytest.mark.realdata
def test_fast_study(realdata, tmp_path):
    """Three minutes on one core: every source has its table and its numbers, and a second run computes nothing."""
    out = tmp_path / "out"
    command = [sys.executable, "-m", "torchcloth.training.studies", "measured", "--fast", "--out", str(out)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "COLUMNS": "160", "TORCHCLOTH_REALDATA": str(realdata)}
    first, again = (
        subprocess.run(command, capture_output=True, text=True, timeout=900, env=environment) for _ in range(2)
    )
    assert first.returncode == again.returncode == 0, first.stderr
    assert "about 0.0 min left" in first.stdout
    assert "min left" not in again.stdout, "nothing is computed twice"
    result = json.loads((out / "measured.json").read_text())
    names = dict(zip(("nylon", "knits", "swings", "sample", "carries"), SOURCE_NAMES, strict=True))
    assert set(result) - {"schema", "timed"} == {name for name, folder in names.items() if (realdata / folder).is_dir()}
    if "nylon" in result:
        _check_nylon(result["nylon"], first.stdout, out)
    if "knits" in result:
        [fabric] = result["knits"].values()
        force = fabric["directions"]["X"]["prediction"]["measured"]["force"]
        assert 0 < force["rms"] < 0.2
        assert "repeats differ" in first.stdout
    if "swings" in result:
        predicted = result["swings"]["predicted"]
        assert predicted["whole"]["rms"] < predicted["null"]["rms"]
        assert 1.0 < predicted["vacuum"]["frequency"] < 1.2
        assert "Only ratios to the areal density are identifiable" in first.stdout
        entrained, plain = (result["timed"]["models"][label]["fitted"] for label in ("entrained", "no memory"))
        assert entrained["all"] < plain["all"]
        assert entrained["lower"] < 0.8 * plain["lower"]
        assert (out / "timed.png").is_file()
    if "carries" in result:
        carried = result["carries"]["models"]["entrained"]["still"]
        assert carried["all"] < 0.010
        assert carried["lower"] < 0.015
        assert "Carries predicted with the fits to the swings" in first.stdout
    if "sample" in result:
        assert "vertices to cloud" in first.stdout
        distances = result["sample"]["distances"]
        assert distances["fitted"]["cloud to surface"] <= distances["fitted"]["cloud to vertices"]
    assert not list(out.glob("progress/*")), "journals last until a fit is kept"


def _check_nylon(result, printed, out):
    inner = [result["left_out"][angle]["measured"]["force"] for angle in ("30", "45")]
    assert all(one["max"] < 0.15 and one["coverage"] > 0.8 for one in inner)
    assert max(one["measured"]["force"]["max"] for one in result["fitted"].values()) < 0.07
    assert "any other angle: torchcloth predict" in printed
    assert (out / "nylon" / "tension.json").is_file()
    assert (out / "nylon.png").is_file()


@pytest.mark.realdata
def test_runs_are_split_and_thinned(measured_in):
    """Twenty fitted, ten others predicted; the first frame, where the cloth hangs still, is always there."""
    source = measured_in("iri_cloth_swings")
    fitted, predicted = swings.split(source, fast=False)
    assert (len(fitted), len(predicted)) == (20, 10)
    assert not set(fitted) & set(predicted)
    every, thinned = (swings.recording(source, predicted[0], n).points for n in (1, 3))
    assert len(thinned) == -(-len(every) // 3)
    assert np.array_equal(thinned.frame(0), every.frame(0))
    assert np.array_equal(thinned.frame(2), every.frame(6))
    assert np.array_equal(thinned.t, every.t[::3])


@pytest.mark.realdata
def test_a_knits_third_pull(measured_in, tmp_path):
    """Near the floor in force; the fit on disk predicts any angle."""
    result = tension.knit(measured_in("knit_tension"), tmp_path, "Pearlized_Cotton_Seed")
    for one in result["directions"].values():
        force = one["prediction"]["measured"]["force"]
        assert one["floor"]["force"] / 2 < force["rms"] < one["floor"]["force"] + 0.06
        assert force["coverage"] > 0.7
    assert "poisson_ratio" in read_tension_model(tmp_path).fitted


def test_without_data_the_study_says_what_it_needs(tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("TORCHCLOTH_REALDATA", raising=False)
    assert main(["measured", "--out", str(tmp_path / "out")]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert "--source; got none; expected a folder with some of nylon_offaxis_tension" in message
    assert "set TORCHCLOTH_REALDATA" in message
    with pytest.raises(InvalidInput, match=r"--source; got .*; expected a folder with some of"):
        find_data_folder(tmp_path)
    assert not (tmp_path / "out").exists()


def test_the_floor_is_the_third_pulls_distance_from_the_mean_of_the_others():
    """Three straight lines of slopes 1, 2 and 3: the third is 1.5 above the mean of the others at strain 1."""
    u = np.linspace(0, 1, 101)
    table = ForceDisplacement(
        length=1.0,
        width=1.0,
        angle=0.0,
        displacement=np.tile(u, 3),
        force=np.concatenate([u, 2 * u, 3 * u]),
        lateral_strain=np.tile(-0.1 * u, 3),
        repeat=np.repeat([1, 2, 3], len(u)),
    )
    floor = tension.repeat_floor(table)
    assert floor["force"] == pytest.approx(1.5 * np.sqrt((u**2).mean()) / 3)
    assert floor["lateral"] == pytest.approx(0.0, abs=1e-12)


def test_frequency_and_decay_are_found_with_their_spread():
    """Swings of 0.9 Hz and B = 30 1/(m s) with noise; drawn again, they differ by what the noise makes of them."""
    draw, t = np.random.default_rng(0), np.linspace(0, 2.5, 26)
    rows = []
    for size in (0.05, 0.07, 0.06, 0.08):
        q = free_swing.damped_oscillation(t, 0.9, 30.0, size, 0.02) + 1e-3 * draw.normal(size=len(t))
        rows.append({"swing_t": t.tolist(), "swing_q": q.tolist(), "squares": 4.0, "count": 100, "median": 0.1})
    runs = {str(k): {"measured": row, "null": row, "still": row, "model": row} for k, row in enumerate(rows)}
    result = swing_predictions.summary(runs, ["model"], draws=5)
    assert result["measured"]["frequency"] == pytest.approx(0.9, abs=0.005)
    assert result["measured"]["decay"] == pytest.approx(30.0, rel=0.05)
    assert 0 < result["model"]["decay_std"] < 3
    assert result["null"]["rms"] == pytest.approx(0.2)
