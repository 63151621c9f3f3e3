"""Errors of a bench are unknowns of a fit by default; a simulation of one's own has an exact bench."""

from dataclasses import replace

import pytest
from helpers.command_line import refuse, write_twin

from torchcloth.cli import main
from torchcloth.errors import InvalidInput
from torchcloth.identification import build_episode, fit, identify
from torchcloth.identification.nuisances import BENCH_CAMERA_STDS, BENCH_CLOTH_STDS, BENCH_RIM_STDS, bench_nuisances

EVERY_USE = ["points", "markers", "force"]
CAMERA, RIM, CLOTH = {"clock", "jitter", "camera"}, {"rim", "rim_scatter"}, {"grasp", "grip", "shape"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The twin episode on disk."""
    return write_twin(tmp_path_factory.mktemp("episodes") / "twin")


@pytest.fixture
def selected(monkeypatch):
    """Standard deviations by name of the nuisances that a fit selected before it was refused."""
    stds = {}

    def stop(cloth, unknowns, episodes, dt, nuisances, *_):
        stds.update({nuisance.name: nuisance.std for nuisance in nuisances})
        raise InvalidInput("enough", got="this", expected="nothing more")

    monkeypatch.setattr(fit, "Objective", stop)
    return stds


@pytest.fixture
def select(model, brief, selected):
    """Nuisances of a fit with these options."""

    def run(**options):
        selected.clear()
        with pytest.raises(InvalidInput, match="enough"):
            identify(model, brief, ["youngs_modulus"], **options)
        return dict(selected)

    return run


def test_a_camera_and_a_measured_first_shape_have_their_errors(model, brief):
    stds = bench_nuisances(EVERY_USE, [build_episode(model, brief)])
    assert set(stds) == CAMERA | RIM | CLOTH
    assert stds == BENCH_CAMERA_STDS | BENCH_RIM_STDS | BENCH_CLOTH_STDS


@pytest.mark.parametrize(
    ("uses", "changes", "names"),
    [
        (["points"], {}, CAMERA | RIM | CLOTH),
        (["force"], {}, CLOTH),  # the camera's frames are not in use
        (["markers"], {"clouds": []}, CLOTH),  # there is no camera
        (["points"], {"needs_settling": False}, CAMERA | RIM),  # the first shape is the rest shape, or was computed
        (["force"], {"needs_settling": False}, set()),
    ],
)
def test_errors_join_by_the_data_that_have_them(model, brief, uses, changes, names):
    assert set(bench_nuisances(uses, [replace(build_episode(model, brief), **changes)])) == names


def test_every_bench_error_is_an_unknown_by_default(select):
    stds = select()
    assert set(stds) == CAMERA | RIM | CLOTH
    assert {name: stds[name] for name in ("clock", "camera", "shape")} == {
        "clock": 0.03,
        "camera": 0.004,
        "shape": 4e-3,
    }


def test_a_stated_deviation_replaces_the_default_and_zero_leaves_one_out(select):
    stds = select(nuisances={"clock": 0.2, "grip": 0})
    assert stds["clock"] == pytest.approx(0.2)
    assert set(stds) == (CAMERA | RIM | CLOTH) - {"grip"}


def test_an_exact_bench_has_what_is_named_only(select):
    assert set(select(exact_bench=True)) == {"rim"}
    assert set(select(exact_bench=True, nuisances=["grasp"])) == {"rim", "grasp"}


def test_other_methods_take_the_bench_as_exact(select):
    assert set(select(method="lbfgs")) == {"rim"}


@pytest.mark.parametrize(
    ("options", "names"),
    [
        ([], CAMERA | CLOTH | {"rim_scatter"}),
        (["--nuisance", "clock=0"], (CAMERA | CLOTH | {"rim_scatter"}) - {"clock"}),
        (["--exact-bench"], set()),
        (["--exact-bench", "--nuisance", "camera"], {"camera"}),
    ],
)
def test_the_command_says_which_errors_are_unknown(folder, tmp_path, capsys, selected, options, names):
    refuse(capsys, tmp_path / "out", "identify", folder, *options)
    assert set(selected) - {"rim"} == names


def test_the_demo_has_an_exact_bench(tmp_path, selected):
    """MuJoCo recorded the demo, so nothing is off but the sensors."""
    assert main(["demo", "--no-refine", "--out", str(tmp_path / "out")]) == 2
    assert set(selected) == {"rim"}
