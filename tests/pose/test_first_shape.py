"""The first shape from a network, on the cloth's mesh."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import twins

import torchcloth as tc
from torchcloth import recordings
from torchcloth.errors import RecordingError
from torchcloth.identification import build_cloth, build_episode
from torchcloth.meshes import rectangle
from torchcloth.observe.align import edge_strain
from torchcloth.pose import FirstShape, estimate_first_shape
from torchcloth.pose.first_shape import _rival_distance

EXAMPLE = Path(tc.__file__).with_name("examples") / "bimanual_swing"
MEASURED_SHAPE_DISTANCE_M = 0.01
SIDE_M = 0.3
GRIP_RADIUS_M = 0.03  # reaches beyond the nearest row of vertices, which the mesh moves to its edge


def test_a_shape_belongs_to_the_mesh_whose_vertices_lie_at_the_edges_of_what_is_held():
    recording = recordings.read(EXAMPLE)
    with twins.use_float64():
        cloth = build_cloth(recording)
        assert not np.allclose(cloth.mesh.uv, recording.cloth.uv)
        shape = estimate_first_shape(cloth, recording)
        measured = build_episode(cloth, recording).initial
        after = shape.apply(recording)
        again = build_cloth(after)
        np.testing.assert_allclose(again.mesh.uv, cloth.mesh.uv)
        for model in (cloth, again):
            torch.testing.assert_close(build_episode(model, after).initial, shape.x.double(), rtol=0, atol=1e-9)
    assert float(edge_strain(cloth.mesh, shape.x).abs().max()) < 0.03
    assert float((shape.x - measured).square().sum(-1).mean().sqrt()) < MEASURED_SHAPE_DISTANCE_M


def test_a_shape_that_no_cloth_has_is_refused(scene):
    """A sheet that is held taut along two edges: no such scene is in the training data."""
    with twins.use_float64():
        grasps = {name: replace(grasp, radius=GRIP_RADIUS_M) for name, grasp in scene.recording.grasps.items()}
        recording = replace(scene.recording, grasps=grasps)
        with pytest.raises(RecordingError, match="strained by"):
            estimate_first_shape(build_cloth(recording), recording)


def test_a_shape_that_the_clouds_do_not_tell_from_another_is_said_to_be_one_of_several():
    mesh = rectangle(SIDE_M, SIDE_M, triangles=8)
    x = torch.as_tensor(mesh.vertices)
    hypotheses, one = torch.stack([x, x + 0.001, x + SIDE_M, x - 2 * SIDE_M]), torch.ones(4)

    def warnings(distances: list[float]) -> list[str]:
        rival = _rival_distance(hypotheses, torch.tensor(distances), 0)
        return FirstShape(mesh, x, one, None, torch.tensor(distances), one, rival).warnings

    (warning,) = warnings([2e-3, 2e-3, 2.8e-3, 4e-3])
    assert f"{1e3 * SIDE_M * 3**0.5:.0f} mm away" in warning
    assert not warnings([2e-3, 2e-3, 4e-3, float("nan")])
