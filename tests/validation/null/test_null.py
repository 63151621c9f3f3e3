"""The comparison of the two engines, small: known distances, and what the page prints."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco", minversion="4.0")

import torch

from torchcloth import meshes
from torchcloth.episodes.replay import Replay
from torchcloth.identification import build_episode
from torchcloth.training.validation.null import report_page, run
from torchcloth.training.validation.null.comparison import (
    FabricValues,
    build_base_model,
    interpolate,
    measure_distance,
    measure_truth_distance,
    read_remeshed,
    true_pattern,
)


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """An effect-free episode on a coarse mesh."""
    study = run.NullStudy(tmp_path_factory.mktemp("null"), ("hang",), 9)
    study._generate("hang", 9)
    return study


@pytest.mark.slow
def test_the_two_engines_agree_on_a_hanging_sheet_and_disagree_about_another_one(study):
    folder = study._episode("hang", 9)
    values, recording = FabricValues.from_truth(folder), read_remeshed(folder, 9)
    right = measure_distance(recording, values)
    assert right.material_rms < 0.6e-3
    assert right.rms_by_frame.shape == recording.truth.t.shape
    assert right.surface_rms <= right.material_rms
    soft = measure_distance(recording, replace(values, membrane_stiffness=0.5 * values.membrane_stiffness))
    assert soft.material_rms > 2 * right.material_rms


def test_truth_as_model_has_no_distance(study):
    folder = study._episode("hang", 9)
    values, recording = FabricValues.from_truth(folder), read_remeshed(folder, 9)
    model = build_base_model(recording, values)
    with torch.no_grad():
        x = Replay(model)(build_episode(model, recording)).x.numpy()
    x_moved = interpolate(model.mesh, true_pattern(recording), x)
    truth = replace(recording.truth, t=recording.points.t, vertices=x_moved)
    same = replace(recording, truth=truth)
    assert measure_distance(same, values).material_rms < 1e-9
    shifted = replace(recording, truth=replace(truth, vertices=x_moved + np.array([0, 0, 3e-3])))
    assert measure_distance(shifted, values).material_rms == pytest.approx(3e-3, rel=1e-6)
    assert measure_truth_distance(same, shifted) == pytest.approx(3e-3, rel=1e-6)


def test_interpolation_is_exact_for_linear_maps_on_any_mesh():
    mesh = meshes.rectangle(0.3, 0.2, resolution=(4, 5))
    turn = np.array([[1.0, 0.2, 0.0], [-0.3, 0.9, 0.4]])
    uv = np.random.default_rng(0).uniform([0, 0], [0.3, 0.2], (40, 2))
    np.testing.assert_allclose(interpolate(mesh, uv, (mesh.uv @ turn)[None])[0], uv @ turn, atol=1e-12)


def test_finished_steps_are_not_repeated_and_the_page_shows_them(study, tmp_path):
    distance = {
        "material_rms": 1e-3,
        "surface_rms": 5e-4,
        "rms_by_frame": [0.0, 1e-3],
        "rms_by_vertex": [0.0, 1e-3, 2e-3, 3e-3],
    }
    values = {"membrane_stiffness": 100.0, "poisson_ratio": 0.3, "bending_stiffness": 1e-5, "damping_time": 0.01}
    finished = run.NullStudy(tmp_path, ("swing",), 17)
    for name, _ in finished.tasks():
        finished.results[name] = 0.5 if name.startswith(("episode", "truth")) else dict(distance)
    finished.results["fit"] = {"values": values, "true": values}
    calls = []
    finished.tasks = lambda: ((name, lambda name=name: calls.append(name)) for name in [*finished.results])
    with run.Progress(disable=True) as progress:
        finished.run(progress)
    assert calls == []
    text = report_page.format_table(finished.results, ("swing",), finished.meshes)
    assert "| swing | 0.50 | 1.00 (0.50) | 1.00 (0.50) | 500.00 |" in text
    assert report_page.draw_figure(finished.results, ("swing",), finished.meshes, tmp_path).stat().st_size > 1000
    assert (
        "bending_stiffness [N m] | 1e-05"
        in report_page.write_page(finished.results, ("swing",), finished.meshes, tmp_path).read_text()
    )
