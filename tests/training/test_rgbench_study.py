"""The study of RGBench on a small synthetic copy of the data set."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

pytest.importorskip("open3d")

from helpers import rgbench_copy

from torchcloth.training.studies.command import main
from torchcloth.training.studies.rgbench import summarise
from torchcloth.training.studies.rgbench_data import PUBLISHED_MEANS_M, Capture
from torchcloth.training.studies.rgbench_simulation import lay_down


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return rgbench_copy.write_copy(tmp_path_factory.mktemp("rgbench"))


def run(data, out, *options) -> int:
    return main(["rgbench", "--data", str(data), "--out", str(out), *options])


def test_the_study_on_a_copy_of_the_layout(data, tmp_path, capsys):
    """The fabric is the true one: what remains is noise (1 mm), clock, grips and first shape, and edges of 50 mm."""
    assert run(data, tmp_path, "--fast") == 0
    first = capsys.readouterr().out
    assert "min left" in first
    cells = {
        (c["garment"], c["action"]): c for c in json.loads((tmp_path / "rgbench_nominal.json").read_text())["cells"]
    }
    fling, fold = (cells["green_tshirt", action] for action in ("fling", "fold"))
    assert fling["simulated"]["surface"] < 4e-3
    assert fold["simulated"]["surface"] < 8e-3
    for cell in (fling, fold):
        assert cell["captures"] == 1
        assert cell["carried"]["surface"] > 4 * cell["simulated"]["surface"]
        assert cell["simulated"]["surface"] < cell["simulated"]["vertices_l2"] < cell["simulated"]["vertices_l1"]
        assert cell["simulated"]["vertices_l1"] < 3**0.5 * cell["simulated"]["vertices_l2"]
    assert fold["published"] == {"MuJoCo with Style3D": 0.0132, "PyBullet": 0.0227, "Isaac Sim": 0.0314}
    assert cells["blue_dress", "fold"]["captures"] == 0
    assert "failed: faces; got 1 edges along which two triangles go the same way" in " ".join(first.split())
    assert "28.4, 43.1, 44.4 mm" in " ".join(first.split())
    assert run(data, tmp_path, "--fast") == 0
    again = capsys.readouterr().out
    assert "min left" not in again, "nothing is computed twice"
    assert first.endswith(again)


@pytest.mark.slow
def test_a_fitted_fabric_predicts_the_other_captures(data, tmp_path, capsys):
    assert run(data, tmp_path, "--fast", "--fit", "--garments", "green_tshirt", "--actions", "fling") == 0
    assert "green_tshirt, fling: fitted" in capsys.readouterr().out
    assert len(list((tmp_path / "cases").iterdir())) == 2


def test_means_of_cells_by_hand():
    cells = [("green_tshirt", "fold")] * 3 + [("shawl", "fling")]
    captures = [Capture(*cell, Path(f"{k}"), 0.0, 1.0) for k, cell in enumerate(cells)]
    rows = [
        {name: {"vertices_l1": x, "surface": x / 2} for name in ("simulated", "carried")} for x in (0.05, 0.01, 0.02)
    ]
    nominal, shawl = summarise(captures, [*rows, {"failed": "damaged"}], fitted=False)
    assert nominal["simulated"]["vertices_l1"] == pytest.approx((0.05 + 0.01 + 0.02) / 3)
    assert nominal["carried"]["surface"] == pytest.approx((0.025 + 0.005 + 0.01) / 3)
    assert (shawl["captures"], shawl["published"]) == (0, None)
    assert "simulated" not in shawl
    predicted, _ = summarise(captures, [*rows, rows[0]], fitted=True)
    assert predicted["simulated"]["vertices_l1"] == pytest.approx((0.01 + 0.02) / 2), "without the fitted capture"
    assert (predicted["captures"], predicted["predicted"]) == (2, True)


def test_the_published_means_are_those_of_the_paper():
    means = np.array(list(PUBLISHED_MEANS_M.values()))
    assert means.shape == (21, 3)
    np.testing.assert_allclose(means.mean(0), [0.0284, 0.0431, 0.0444], atol=5e-5)


def test_a_garment_is_laid_under_its_first_cloud():
    garment, _ = rgbench_copy.make_garment()
    turn, shift = np.array([[np.cos(0.2), -np.sin(0.2), 0], [np.sin(0.2), np.cos(0.2), 0], [0, 0, 1]]), [0.16, 0.05, 0]
    cloud = np.concatenate([garment.vertices[:, :2] @ turn[:2, :2].T + shift[:2], np.zeros((49, 1))], axis=1)
    rotation, placed = lay_down(garment.vertices, cloud)
    np.testing.assert_allclose(rotation, turn, atol=1e-9)
    np.testing.assert_allclose(placed, [*shift[:2], 1e-3 - 5e-3], atol=1e-9)


def test_what_is_missing_is_named_in_one_line(data, tmp_path, capsys):
    def refuse(*options: str) -> str:
        assert run(data, tmp_path / "out", *options) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert not (tmp_path / "out").exists()
        return error

    assert "name the folder configs of a clone of github.com/hwk0809/RGBench" in refuse("--configs", str(tmp_path))
    library = tmp_path / "experiment_library.yaml"
    library.write_text("experiments: [")
    assert "experiment_library.yaml: ParserError" in refuse("--configs", str(tmp_path))
    library.write_text("experiments: {a: {fold: {piper: {'01': {data_subfolder: x}}}}}")
    assert "a, fold; got KeyError('evaluate'); expected data_subfolder, and" in refuse("--configs", str(tmp_path))
    library.write_text("experiments: {}")
    assert "--data; got none of 0 captures" in refuse("--configs", str(tmp_path))
    assert "--garments; got sock; expected some of blue_dress, green_tshirt" in refuse("--garments", "sock")
    assert "--captures; got 0; expected 1 or more" in refuse("--fast", "--captures", "0")


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"stretch": "stiff"}, "stretch; got 'stiff'; expected a number"),
        ({"shoulder_index": [0, 900]}, "shoulder_index; got [0, 900]; expected vertices below 49"),
        ({"cloth_model_file_name": "none.obj"}, "expected a mesh of the data set"),
    ],
)
def test_a_garment_that_is_described_wrongly_fails_alone(data, tmp_path, capsys, changes, reason):
    configs = tmp_path / "configs"
    (configs / "cloth_params").mkdir(parents=True)
    for name in ("experiment_library.yaml", "cloth_params/green_tshirt.yaml"):
        (configs / name).write_text((data / "configs" / name).read_text())
    path = configs / "cloth_params" / "green_tshirt.yaml"
    path.write_text(yaml.safe_dump({**yaml.safe_load(path.read_text()), **changes}))
    options = ["--garments", "green_tshirt", "--actions", "fold", "--configs", str(configs)]
    assert run(data, tmp_path / "out", *options) == 0
    assert reason in " ".join(capsys.readouterr().out.split())
