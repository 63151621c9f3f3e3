"""CUDA runs the same code; no figures yet, no machine of ours had one. Run with `pytest -m gpu -s`."""

import time

import pytest
import torch

import torchcloth as tc
from torchcloth import captured

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.filterwarnings("error:no CUDA graph"),
    pytest.mark.filterwarnings("error:The CUDA Graph is empty"),
]
CONTACT = {"contact": tc.Contact(), "none": None}


@pytest.fixture(autouse=True)
def cuda():
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")


def lifted(device: str, engine: str, dtype: torch.dtype, contact: str, duration: float):
    """(positions, the modulus' gradient, seconds of the second call) of a sheet that a corner lifts."""
    t = torch.linspace(0, duration, 5, dtype=dtype)
    pose = torch.eye(4, dtype=dtype).repeat(5, 1, 1)
    pose[:, 2, 3] = t
    motion = {"hand": tc.Trajectory(t, pose, torch.ones(5, dtype=torch.bool))}
    cloth = tc.Cloth(
        tc.meshes.rectangle(0.2, 0.2, resolution=(6, 6)),
        tc.materials.AEP(5e4),
        0.3,
        {"gravity": tc.effects.Gravity(), "air": tc.effects.AirDrag(), "bending": tc.effects.Bending()},
        {"hand": tc.boundaries.Grasp.corner("upper-left"), "table": tc.boundaries.Plane((0.0, 0.0, -0.1))},
        contact=CONTACT[contact],
        engine=engine,
    ).to(device, dtype)
    for _ in range(2):
        cloth.zero_grad()
        began = time.perf_counter()
        out = cloth(cloth.rest_state(), motion, times=[0.0, duration / 2, duration])
        out.x.square().sum().backward()
        grad = cloth.material.youngs_modulus.raw.grad.cpu()  # waits for the device
        seconds = time.perf_counter() - began
    return out.x.detach().cpu(), grad, seconds


@pytest.mark.parametrize("contact", CONTACT)
@pytest.mark.parametrize(("dtype", "mark"), [(torch.float64, 1e-9), (torch.float32, 1e-4)])
def test_cuda_equals_cpu(monkeypatch, dtype, mark, contact):
    """Captured, and launched one by one."""
    units = []
    usual = captured.Unit.__init__
    monkeypatch.setattr(captured.Unit, "__init__", lambda self, *how: (units.append(self), usual(self, *how))[1])
    known, gradient, _ = lifted("cpu", "reference", dtype, contact, 0.2)
    for engine in ("auto", "reference"):
        units.clear()
        x, grad, _ = lifted("cuda", engine, dtype, contact, 0.2)
        torch.testing.assert_close(x, known, rtol=mark, atol=mark)
        torch.testing.assert_close(grad, gradient, rtol=10 * mark, atol=10 * mark * float(gradient.abs()))
        assert bool(units) == (engine == "auto"), "captured"


class Waits(tc.effects.AbstractEffect):
    """It brings a number from the processor in every substep."""

    def coefficients(self):
        return None

    def force(self, c, now):
        return torch.tensor([0.0, 0.0, 1e-3]).to(now.x).expand_as(now.x)


@pytest.mark.filterwarnings("default:no CUDA graph")
def test_a_part_that_waits_is_launched_one_by_one_and_spoils_nothing():
    mesh = tc.meshes.rectangle(0.2, 0.2, resolution=(6, 6))
    stream = torch.cuda.current_stream()
    cloth = tc.Cloth(mesh, tc.materials.AEP(5e4), 0.3, {"waits": Waits()}, contact=None).cuda()
    with pytest.warns(UserWarning, match="no CUDA graph of the substeps"):
        cloth(cloth.rest_state(), times=[0.0, 0.2])
    assert torch.cuda.current_stream() == stream
    torch.cuda.empty_cache()
    assert not captured.Graphs.broken
    plain = tc.Cloth(mesh, tc.materials.AEP(5e4), 0.3, {"gravity": tc.effects.Gravity()}, contact=None).cuda()
    assert torch.isfinite(plain(plain.rest_state(), times=[0.0, 0.2]).x).all()


def test_graphs_pay():
    """Prints by how much, forward and back together."""
    *_, launched = lifted("cuda", "reference", torch.float32, "contact", 0.5)
    *_, captured = lifted("cuda", "auto", torch.float32, "contact", 0.5)
    print(f"\n{torch.cuda.get_device_name()}: {launched:.2f} s one by one, {captured:.2f} s in graphs")
    assert captured < launched / 2


def test_it_says_so():
    mesh = tc.meshes.rectangle(0.2, 0.2, resolution=(3, 3))
    cloth = tc.Cloth(mesh, tc.materials.AEP(5e3), 0.3).cuda()
    assert cloth.engine_in_use == "reference, in CUDA graphs (tensors on cuda)"
