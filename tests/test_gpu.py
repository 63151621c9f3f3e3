"""CUDA gives what the CPU gives: `pytest -m gpu -s`. With a device, `tests/engine` runs every kernel there."""

import time
from contextlib import nullcontext

import pytest
import torch

import torchcloth as tc
from torchcloth.benchmarks import devices
from torchcloth.engine import cuda_graphs

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.filterwarnings("error:no CUDA graph"),
    pytest.mark.filterwarnings("error:The CUDA Graph is empty"),
    pytest.mark.filterwarnings("error:the engine on"),
]
CONTACT = {"contact": tc.Contact(), "none": None}


@pytest.fixture(autouse=True)
def cuda():
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")


def lifted(path: devices.SimulationPath, dtype: torch.dtype, contact: str, duration: float):
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
        engine=path.engine,
    ).to(path.device, dtype)
    for _ in range(2):
        cloth.zero_grad()
        began = time.perf_counter()
        with devices.force_cuda_graphs() if path.uses_cuda_graphs else nullcontext():
            out = cloth(cloth.rest_state(), motion, times=[0.0, duration / 2, duration])
        out.x.square().sum().backward()
        grad = cloth.material.youngs_modulus.raw.grad.cpu()  # waits for the device
        seconds = time.perf_counter() - began
    return out.x.detach().cpu(), grad, seconds


PATHS = {
    "engine": devices.SimulationPath("cuda", "auto"),
    "graphs": devices.SimulationPath("cuda", "auto", uses_cuda_graphs=True),
    "one by one": devices.SimulationPath("cuda", "reference"),
}


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("contact", CONTACT)
@pytest.mark.parametrize(("dtype", "mark"), [(torch.float64, 1e-9), (torch.float32, 1e-4)])
def test_cuda_equals_cpu(monkeypatch, dtype, mark, contact, path):
    segments = []
    usual = cuda_graphs.GraphedSegment.__init__
    monkeypatch.setattr(
        cuda_graphs.GraphedSegment, "__init__", lambda self, *how: (segments.append(self), usual(self, *how))[1]
    )
    known, gradient, _ = lifted(devices.SimulationPath("cpu", "auto"), dtype, contact, 0.3)
    x, grad, _ = lifted(PATHS[path], dtype, contact, 0.3)
    torch.testing.assert_close(x, known, rtol=mark, atol=mark)
    torch.testing.assert_close(grad, gradient, rtol=10 * mark, atol=10 * mark * float(gradient.abs()))
    assert bool(segments) == (path == "graphs"), "captured"


@pytest.mark.parametrize(("dtype", "mark"), [(torch.float64, 1e-8), (torch.float32, 1e-3)])
def test_layers_that_meet(dtype, mark):
    """One half of a sheet falls onto the other."""
    results = {}
    for device in ("cpu", "cuda"):
        mesh = tc.meshes.rectangle(0.2, 0.2, resolution=(17, 17))
        cloth = tc.Cloth(mesh, tc.materials.AEP(5e3), 0.3, {"gravity": tc.effects.Gravity()}).to(device, dtype)
        x = cloth.rest_state().x.clone()
        right = x[:, 0] > 0.1
        x[right, 0], x[right, 2] = 0.2 - x[right, 0], 0.004
        state = cloth.state(x)
        for _ in range(2):  # the same in every run
            cloth.zero_grad()
            out = cloth(
                state._replace(v=torch.tensor([0.0, 0.0, -2.0]).to(x) * right.unsqueeze(-1)), times=[0.0, 0.01, 0.02]
            )
            (out.x[-1].square().sum() + out.state.d3[:, 2].sum()).backward()
            grads = [cloth.get_parameter(name).grad for name in ("areal_density.raw", "material.contact_stiffness.raw")]
            again = torch.cat([out.x.detach().flatten(), torch.stack(grads)]).cpu()  # type: ignore[arg-type]
            assert device not in results or torch.equal(again, results[device])
            results[device] = again
    assert float(results["cpu"][-1]) != 0, "they press"
    torch.testing.assert_close(results["cuda"][:-2], results["cpu"][:-2], rtol=0, atol=mark * 0.2)
    torch.testing.assert_close(results["cuda"][-2:], results["cpu"][-2:], rtol=100 * mark, atol=0)


def test_sensitivities_are_those_of_the_cpu():
    results = []
    for device in ("cpu", "cuda"):
        cloth = devices.sheet("auto", python=False).to(device, torch.float64)
        along = tc.Directions({"areal_density.raw": torch.ones(1, device=device)})
        results.append(
            cloth.sensitivities(cloth.rest_state(), devices.motion(0.05), [0.0, 0.05], along=along)[1].x.cpu()
        )
    torch.testing.assert_close(results[1], results[0], rtol=1e-7, atol=1e-9)


class Waits(tc.effects.AbstractEffect):
    """It brings a number from the processor in every substep."""

    def coefficients(self):
        return None

    def force(self, c, inputs):
        return torch.tensor([0.0, 0.0, 1e-3]).to(inputs.x).expand_as(inputs.x)


@pytest.mark.filterwarnings("default:no CUDA graph")
def test_a_part_that_waits_is_launched_one_by_one_and_spoils_nothing():
    mesh = tc.meshes.rectangle(0.2, 0.2, resolution=(6, 6))
    stream = torch.cuda.current_stream()
    cloth = tc.Cloth(mesh, tc.materials.AEP(5e4), 0.3, {"waits": Waits()}, contact=None).cuda()
    with pytest.warns(UserWarning, match="no CUDA graph of the substeps"):
        cloth(cloth.rest_state(), times=[0.0, 1.0])
    assert torch.cuda.current_stream() == stream
    torch.cuda.empty_cache()
    assert not cuda_graphs.GraphedRollout.capture_is_broken
    plain = tc.Cloth(mesh, tc.materials.AEP(5e4), 0.3, {"gravity": tc.effects.Gravity()}, contact=None).cuda()
    assert torch.isfinite(plain(plain.rest_state(), times=[0.0, 1.0]).x).all()


def test_the_engine_pays():
    """Prints by how much, forward and back together."""
    took = {name: lifted(path, torch.float32, "contact", 0.3)[-1] for name, path in PATHS.items()}
    print(f"\n{torch.cuda.get_device_name()}: {', '.join(f'{name} {s:.3f} s' for name, s in took.items())}")
    assert took["engine"] < took["graphs"] < took["one by one"] / 2


def test_it_says_so():
    mesh = tc.meshes.rectangle(0.2, 0.2, resolution=(3, 3))
    assert tc.Cloth(mesh, tc.materials.AEP(5e3), 0.3).cuda().engine_in_use == "fused"
    cloth = tc.Cloth(mesh, tc.materials.AEP(5e3), 0.3, {"waits": Waits()}, contact=None).cuda()
    assert cloth.engine_in_use == "reference, in CUDA graphs (effects.waits in torch, on cuda)"
