"""A sheet that swings down from the horizontal, held at one edge, in MuJoCo and Newton from the exported files."""

import numpy as np
import pytest
import torch
from helpers.twins import use_float64

import torchcloth as tc
from torchcloth import effects, recordings
from torchcloth.export import export_cloth
from torchcloth.training.validation.export.mujoco_replay import replay_in_mujoco
from torchcloth.training.validation.export.newton_replay import replay_in_newton
from torchcloth.training.validation.export.swing import EXAMPLE, Swing, build_fitted_cloth

SIDE_M, SECONDS = 0.24, 0.3


@pytest.fixture(scope="module")
def swing():
    with use_float64():
        mesh = tc.meshes.rectangle(SIDE_M, SIDE_M, resolution=(6, 6))
        parts = {"gravity": effects.Gravity(), "bending": effects.Bending(2e-6, 0.005), "air": effects.AirDrag(1.2)}
        held = np.flatnonzero(mesh.uv[:, 0] < 1e-9)
        grasp = {"bar": tc.boundaries.Grasp(held)}
        cloth = tc.Cloth(mesh, tc.materials.AEP(6e4, 0.3), 0.2, parts, grasp, None)
        t = torch.linspace(0.0, SECONDS, 13)
        still = tc.Trajectory(t[[0, -1]], torch.eye(4).expand(2, 4, 4), torch.ones(2, dtype=torch.bool))
        with torch.no_grad():
            x = cloth(cloth.rest_state(), {"bar": still}, t).x.numpy()
        return Swing(cloth, t.numpy(), x, held, t.numpy(), x[:, held])


def test_mujoco_follows_best_with_drag_on_triangles_and_not_without_air(swing):
    text = export_cloth(swing.cloth, "mujoco").text
    assert np.ptp(swing.x[..., 2]) > 0.1
    assert swing.rms_distance(replay_in_mujoco(text, swing, "triangles")) < 1e-3
    assert swing.rms_distance(replay_in_mujoco(text, swing)) < 1e-2  # its drag is along the axes of the world
    assert swing.rms_distance(replay_in_mujoco(text, swing, "none")) > 2e-2


@pytest.mark.parametrize(("solver", "step"), [("SolverSemiImplicit", 2e-4), ("SolverVBD", 1e-3)])
def test_newton_follows(swing, solver, step):
    pytest.importorskip("newton")
    text = export_cloth(swing.cloth, "newton").text
    assert swing.rms_distance(replay_in_newton(text, swing, solver, step)) < 2e-3


def test_the_file_starts_where_the_recording_does():
    with use_float64():
        recording = recordings.read(EXAMPLE)
        export = export_cloth(build_fitted_cloth(recording), "mujoco", initial=recording.cloth.initial_vertices)
    assert 'key name="first_frame"' in export.text
