"""CUDA runs the same code; no figures yet, no machine of ours had one. Run with `pytest -m gpu`."""

import pytest
import torch

import torchcloth as tc

pytestmark = pytest.mark.gpu


def test_cuda_equals_cpu():
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    mesh = tc.meshes.rectangle(0.2, 0.2, resolution=(6, 6))
    t = torch.linspace(0, 0.1, 5)
    pose = torch.eye(4).repeat(5, 1, 1)
    pose[:, 2, 3] = t
    motion = {"hand": tc.Trajectory(t, pose, torch.ones(5, dtype=torch.bool))}
    ends = []
    for device in ("cpu", "cuda"):
        cloth = tc.Cloth(
            mesh,
            tc.materials.AEP(5e4),
            0.3,
            {"gravity": tc.effects.Gravity(), "air": tc.effects.AirDrag(), "bending": tc.effects.Bending()},
            {"hand": tc.boundaries.Grasp.corner("upper-left")},
        ).to(device)
        out = cloth(cloth.rest_state(), motion, times=[0.0, 0.05, 0.1])
        out.x.square().sum().backward()
        ends.append((out.x.detach().cpu(), cloth.material.youngs_modulus.raw.grad.cpu()))
    torch.testing.assert_close(ends[1], ends[0], rtol=1e-9, atol=1e-9)
