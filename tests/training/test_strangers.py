"""The study of strangers' benches: what is drawn, how it scores, and a reduced run from files to table."""

import json
from collections import Counter

import numpy as np
import pytest

from torchcloth.training.studies import strangers_tables
from torchcloth.training.studies.command import main
from torchcloth.training.studies.honesty import PARAMETER_SYMBOLS, THIS_VERSION
from torchcloth.training.validation.independent import stranger_bench


def case(holding, refused="", **values):
    """A fit of a bench whose true numbers are 1, with a standard error of 0.1."""
    fitted = {
        name: {"value": value, "std": 0.1, "ci95": [value - 0.2, value + 0.2], "identifiable": True}
        for name, value in values.items()
    }
    return {
        "holding": holding,
        "camera": "kinect",
        "motion": "swing",
        "faults": {"grip": "hinge", "lag": "20 ms"},
        "truth": dict.fromkeys(PARAMETER_SYMBOLS, 1.0),
        "parameters": {name.replace("__", "."): e for name, e in fitted.items()},
        "refused": refused,
        "cpu_seconds": 10.0,
    }


ANSWERS = {
    "a": {
        0: case("bar", air__normal=1.1, membrane_stiffness=1.5),
        1: case("corners", air__normal=0.9),
        2: case("corner", refused="new: no cloth"),
        3: case("bar", bending__stiffness=1.0),
    }
}


def test_scores_are_by_holding_and_for_all():
    rows = {
        row[1]: dict(zip(strangers_tables.SCORE_HEADINGS, row, strict=True)) for row in strangers_tables.score(ANSWERS)
    }
    assert list(rows) == ["edge on a bar", "two corners", "one corner", "all"]
    bar, total = rows["edge on a bar"], rows["all"]
    assert (bar["benches"], bar["E h"], bar["B"], bar["C_n"], bar["ν"]) == ("2", "1", "1", "1", "0")
    assert (bar["drag"], bar["E h or B"]) == ("50 %", "100 %")
    assert total["95 % intervals that hold the truth"].startswith("3 of 4 = 75 %")
    assert total["more than 3 standard errors off"].startswith("1 of 4")
    assert (total["refused"], rows["one corner"]["refused"]) == ("1", "1")


def test_tables_name_every_bench_and_what_is_wrong_with_it():
    episode = {"holding": "bar", "camera": "kinect", "quality": None, "seconds_new": 3.0}
    text = strangers_tables.write_markdown(ANSWERS, {0: episode})
    assert "| 0 | edge on a bar, kinect, swing | grip hinge, lag 20 ms | a | 1.50 ± 0.10 ! |" in text
    assert text.count("refused |") >= 2


def test_benches_have_every_holding_motion_and_camera_and_two_to_four_faults():
    draw = (stranger_bench.holding_of_seed, stranger_bench.motion_of_seed, stranger_bench.camera_of_seed)
    assert len({tuple(one(seed) for one in draw) for seed in range(24)}) == 24
    names = [stranger_bench.draw_faults(seed, np.random.default_rng(seed))[1] for seed in range(66)]
    assert {len(faults) for faults in names} == {2, 3, 4}
    counts = Counter(name for faults in names for name in faults)
    assert counts.pop("grip") == 66
    assert counts.keys() == stranger_bench.FURTHER_FAULTS.keys()
    assert min(counts.values()) >= 15


@pytest.mark.parametrize(
    "options", [["--benches", "0"], ["--first", "-1"], ["--jobs", "0"], ["--compare", "old=/no/such/python"]]
)
def test_wrong_options_are_refused(tmp_path, capsys, options):
    assert main(["strangers", "--out", str(tmp_path / "a"), *options]) == 2
    assert "--" in capsys.readouterr().err
    assert not (tmp_path / "a").exists()


@pytest.mark.slow  # a minute
def test_a_reduced_study_runs_from_the_files_to_the_table(tmp_path, capsys):
    benches = tmp_path / "benches"
    assert (
        main(["strangers", "--out", str(tmp_path / "a"), "--fast", "--episodes", str(benches), "--episodes-only"]) == 0
    )
    truth = json.loads((benches / "000" / "truth.json").read_text())
    assert truth["quality"]["points_m"] < 0.012  # the bias of the camera
    assert truth["quality"]["foreign"] < 0.02
    assert truth["quality"]["first_shape_m"] < 0.03
    assert abs(truth["quality"]["clock_s"]) < 0.03
    # the files are enough: an episode that is there is fitted without MuJoCo
    assert main(["strangers", "--out", str(tmp_path / "b"), "--fast", "--episodes", str(benches)]) == 0
    result = json.loads((tmp_path / "b" / "strangers.json").read_text())
    (answer,) = result["answers"][THIS_VERSION].values()
    assert answer["refused"] == ""
    assert answer["parameters"].keys() == PARAMETER_SYMBOLS.keys()
    assert "edge on a bar" in capsys.readouterr().out
