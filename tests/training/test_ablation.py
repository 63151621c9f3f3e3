"""The ablation's scenes, and that a study is kept, continued and refused as promised."""

import json
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool

import numpy as np
import pytest
import torch

from torchcloth.errors import InvalidInput
from torchcloth.materials import AEP
from torchcloth.training.ablation import command, runs
from torchcloth.training.ablation.measures import (
    energies_without_each,
    scaled_poisson,
)
from torchcloth.training.ablation.scenes import (
    COROTATED,
    GARMENTS,
    LEVELS,
    PARAMETERS,
    PERTURBATION_STD_M,
    PERTURBED,
    REFERENCE,
    Scene,
    Setup,
    Variant,
)

# -- scenes ---------------------------------------------------------------------------------------------------------

COARSE = Setup(triangles=150, pace=4.0)

# A variant of a thousandth of k, whose layers pass through each other, is part of the ablation.
pytestmark = pytest.mark.filterwarnings("ignore:contact. a stiffness k h of .* cannot carry")


@pytest.mark.parametrize("garment", GARMENTS)
@pytest.mark.parametrize("action", ["fling", "drag", "cover"])
def test_scenes_start_unstrained_above_the_table(garment, action):
    scene = Scene(COARSE, garment, action)
    assert scene.start[:, 2].min() >= 0
    cloth = scene.cloth([REFERENCE])
    with torch.no_grad():
        membrane = float(energies_without_each(cloth.build_model(), cloth.rest_state())["total"])
    weight = 9.81 * COARSE.areal_density * scene.mesh.area.sum()
    assert membrane < 1e-4 * weight * scene.mesh.mean_edge, "nothing springs up at the start"
    for name, at in scene.action.motion.items():
        place = scene.start[scene.mesh.places[scene.garment.grips[name]]].mean(0)
        np.testing.assert_allclose(at.pose[0, :3, 3], place)
    size = np.ptp(scene.start, axis=0).max()
    assert 0.25 < size < 0.6, "half the size of a garment"


def test_one_step_serves_all_variants():
    scene = Scene(COARSE, "shirt", "drag")
    variants = [Variant(p, level) for p in PARAMETERS for level in LEVELS]
    assert scene.stable_step_of_all() <= scene.cloth(variants).stable_step() * (1 + 1e-12)


def test_variants_scale_one_parameter_each():
    scene = Scene(COARSE, "trousers", "drag")
    material = scene.cloth([REFERENCE, Variant("E", 25), Variant("nu", 175), COROTATED]).material
    preset = AEP.preset("pants")
    ratio = {
        name: (getattr(material, name).value / getattr(preset, name).value).flatten().tolist()
        for name in PARAMETERS.values()
    }
    assert ratio["youngs_modulus"] == pytest.approx([1, 0.25, 1, 1])
    nu = scaled_poisson(0.071, 1.75) / 0.071
    assert ratio["poisson_ratio"] == pytest.approx([1, 1, nu, 1])
    assert ratio["contact_stiffness"] == pytest.approx([1, 1, 1, 0], abs=1e-6)
    assert ratio["shear_stiffness"] == pytest.approx([1, 1, 1, 0], abs=1e-6)


def test_a_batch_is_what_its_runs_are_alone(monkeypatch):
    scene = Scene(COARSE, "shirt", "drag")
    monkeypatch.setattr(scene, "frame_times", lambda: [0.0, 0.02, 0.04])
    together = list(scene.simulate([REFERENCE, PERTURBED, Variant("E", 25)]))[-1][1]
    alone = list(scene.simulate([Variant("E", 25)]))[-1][1][0]
    np.testing.assert_allclose(together[2].x, alone.x, atol=1e-6)
    np.testing.assert_allclose(together[2].energy["total"], alone.energy["total"], rtol=1e-6, atol=1e-12)
    start = together[1].x[0] - together[0].x[0]
    assert 0.5 * PERTURBATION_STD_M < start.std() < 2 * PERTURBATION_STD_M
    assert np.abs(together[2].x[-1] - together[0].x[-1]).max() > 10 * PERTURBATION_STD_M


# -- the command ----------------------------------------------------------------------------------------------------

SMALL = ["--triangles", "60", "--garments", "dress", "--actions", "drag", "--pace", "8", "--levels", "25"]


def call(out, *more):
    return command.main(["--out", str(out), *SMALL, *more])


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A study of one scene and one level: 7 runs."""
    out = tmp_path_factory.mktemp("ablation") / "study"
    torch.set_default_dtype(torch.float64)
    assert call(out) == 0
    return out


def test_it_writes_tables_and_pictures(finished, capsys):
    assert call(finished) == 0
    printed = capsys.readouterr().out
    result = json.loads((finished / "result.json").read_text())
    row = result["actions"]["drag"]["chamfer_cm"]
    assert f"{row['E-025']:.3f}" in printed
    assert "0.84" in printed, "the paper's number beside it"
    assert "7 runs, 7 finished" in printed
    assert set(row) == {"perturbed", "corotated", "E-025", "nu-025", "k-025", "gamma-025"}
    assert row["E-025"] > 3 * row["perturbed"], "four times softer cloth takes another shape"
    assert result["actions"]["drag"]["energy"]["E"] == pytest.approx(1.0, abs=0.01)
    assert result["scenes"]["dress drag"]["chamfer_cm"]["E-025"] == pytest.approx(row["E-025"])
    for picture in ("ablation.png", "shapes.png"):
        assert (finished / picture).stat().st_size > 20_000
    assert not [path for path in finished.rglob(".*") if path.is_file()]


@pytest.mark.slow
def test_finished_runs_are_never_repeated(finished, monkeypatch, capsys):
    before = {path: path.stat().st_mtime_ns for path in (finished / "runs").iterdir()}
    simulated = []
    simulate = Scene.simulate
    monkeypatch.setattr(Scene, "simulate", lambda self, v: simulated.extend(v) or simulate(self, v))
    assert call(finished) == 0
    assert simulated == []
    assert call(finished, "--levels", "25", "175") == 0
    assert simulated == [Variant(p, 175) for p in PARAMETERS]
    after = {path: path.stat().st_mtime_ns for path in (finished / "runs").iterdir()}
    assert {path: after[path] for path in before} == before
    assert len(after) == len(before) + 4


@pytest.mark.slow
def test_a_stopped_study_keeps_what_is_finished_and_goes_on(finished, tmp_path, monkeypatch, capsys):
    simulate, calls = Scene.simulate, []

    def interrupted(self, variants):
        calls.append(variants)
        steps = simulate(self, variants)
        if len(calls) == 2:
            next(steps)
            raise KeyboardInterrupt
        yield from steps

    with monkeypatch.context() as patch:
        patch.setattr(Scene, "simulate", interrupted)
        assert call(tmp_path, "--batch", "4") == 130
    assert "the same command continues" in capsys.readouterr().err
    assert len(list((tmp_path / "runs").iterdir())) == 4
    assert call(tmp_path, "--report") == 0
    assert "runs: 4 of 7" in capsys.readouterr().out
    assert call(tmp_path) == 0
    for path in (tmp_path / "runs").iterdir():
        own, other = (np.load(p) for p in (path, finished / "runs" / path.name))
        np.testing.assert_allclose(own["x"][:3], other["x"][:3], atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--triangles", "-5"], "triangles"),
        (["--scale", "nan"], "scale"),
        (["--spacing", "0"], "spacing"),
        (["--pace", "-1"], "pace"),
        (["--jobs", "0"], "--jobs"),
        (["--batch", "0"], "--batch"),
        (["--garments", "shirt", "--triangles", "100"], "triangles"),
        (["--report"], "no finished reference run"),
    ],
)
def test_refusals_write_nothing(arguments, message, tmp_path, capsys):
    out = tmp_path / "out"
    assert call(out, *arguments) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert message in error
    assert not out.exists()


@pytest.mark.parametrize("arguments", [["--garments", "hat"], ["--actions", "iron"], ["--levels", "30"]])
def test_unknown_choices(arguments, tmp_path, capsys):
    with pytest.raises(SystemExit, match="2"):
        call(tmp_path / "out", *arguments)
    assert "invalid choice" in capsys.readouterr().err


def test_a_folder_with_other_settings_is_refused(finished, tmp_path, capsys):
    assert call(finished, "--scale", "0.6") == 2
    assert "scale 0.5; expected scale 0.6" in " ".join(capsys.readouterr().err.split()).replace("got a study with ", "")
    (tmp_path / "file").write_text("")
    assert call(tmp_path / "file") == 2
    assert "a file" in capsys.readouterr().err


def test_a_damaged_run_is_named(finished, tmp_path, capsys):
    study = runs.AblationStudy(tmp_path, Setup(triangles=60, pace=8.0))
    study.start()
    (tmp_path / "runs" / "dress-drag-reference.npz").write_bytes(b"half")
    assert call(tmp_path, "--report") == 2
    assert "dress-drag-reference.npz: unreadable" in capsys.readouterr().err


@pytest.mark.slow
def test_two_processes_do_the_same(finished, tmp_path):
    assert call(tmp_path, "--jobs", "2", "--batch", "4") == 0
    for path in (tmp_path / "runs").iterdir():
        own, other = (np.load(p) for p in (path, finished / "runs" / path.name))
        np.testing.assert_allclose(own["x"][:3], other["x"][:3], atol=1e-6)


@pytest.mark.slow
def test_the_fast_study(tmp_path):
    """All nine scenes: E leads where chaos lets it, and its membrane holds most of the energy, as in the paper."""
    assert command.main(["--out", str(tmp_path), "--fast"]) == 0
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["runs"] == {"finished": 99, "of": 99}
    for action, row in result["actions"].items():
        assert row["energy"]["E"] > 0.8, action
        assert 0 < row["energy"]["nu"] < 0.3, action
    for action in ("drag", "cover"):
        assert result["agreement"]["order"][action]["ours"][0] == "E", action
    calm = result["scenes"]["trousers drag"]["chamfer_cm"]
    assert calm["E-025"] > 100 * calm["perturbed"]
    assert result["agreement"]["chamfer"]["all"] > 0.4


def test_a_process_that_the_system_ends_is_one_line(monkeypatch, tmp_path):
    """Out of memory, as a rule."""

    class Pool:
        def __init__(self, *_, **__):
            pass

        def submit(self, *_):
            ended = Future()
            ended.set_exception(BrokenProcessPool("a process was terminated abruptly"))
            return ended

        def shutdown(self, **_):
            pass

    monkeypatch.setattr(runs, "ProcessPoolExecutor", Pool)
    study = runs.AblationStudy(tmp_path / "s", Setup())
    with pytest.raises(InvalidInput, match="--jobs; got 2, and the system ended one of them"):
        runs.simulate_batches(study, [runs.Batch(("shirt", "drag"), [])], 2, lambda *_: None)
