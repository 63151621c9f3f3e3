"""Programs as CUDA C++, by a stand-in that runs anywhere; ``agreement.agree`` looks at every kernel."""

from contextlib import contextmanager, nullcontext
from functools import partial
from unittest.mock import patch

import pytest
import torch
from helpers import cuda_on_host
from helpers.engine_agreement import make_moving_state
from helpers.engine_cloths import make_opening_motion, make_perturbed_state, make_sheet

import torchcloth as tc
from torchcloth.boundaries.motion import sample_trajectory
from torchcloth.engine import devices, dispatch, enums, execution
from torchcloth.engine.building import EngineUnavailable
from torchcloth.engine.cuda import kernel_codegen, launch, program_ir, self_test
from torchcloth.engine.fused import FusedEngine
from torchcloth.engine.library import kernels
from torchcloth.simulation.initial_state import random_contact_state

pytestmark = pytest.mark.filterwarnings("error:the engine on")
TIMES = [0.0, 0.01, 0.02]


@contextmanager
def elsewhere(**how):
    """Tensors of the CPU are a device's."""
    with cuda_on_host.replace_device_by_host(**how), patch.object(devices, "is_on_device", lambda tensor: True):
        yield


def job_of(cloth, scenes=(2,), substeps=12, state=None):
    state, dt = make_moving_state(cloth, scenes) if state is None else state, 1e-4
    times = torch.arange(substeps + 1, dtype=torch.float64) * dt
    prescribed = {name: sample_trajectory(t, times) for name, t in make_opening_motion(float(times[-1])).items()}
    with patch.object(devices, "is_on_device", lambda tensor: True):
        fused = FusedEngine(cloth.build_model(), state, prescribed)
    job = fused.job(state, torch.full((substeps,), dt), prescribed)
    return job._replace(inputs={f: t.detach().contiguous() for f, t in job.inputs.items()})


def adjoints(job):
    generator = torch.Generator().manual_seed(0)
    seeds = {
        f: torch.randn(job.scenes, f.rows, f.comps, generator=generator, dtype=job.like.dtype)
        for f in job.program.outputs
    }
    return launch.reverse(job, launch.forward(job)[1], seeds, set(job.inputs))


@pytest.mark.slow
@pytest.mark.parametrize("meets", [False, True])
def test_order_of_threads_between_waits_does_not_matter(meets):
    """Bit by bit: nobody reads what another thread of a block writes before both have waited."""
    cloth = make_sheet(contact=tc.Contact(), n=17) if meets else make_sheet()
    job, results = job_of(cloth, state=folded(cloth) if meets else None), []
    for reverse in (False, True):
        with cuda_on_host.replace_device_by_host(4, reverse):
            results.append((launch.forward(job)[0], adjoints(job)))
            assert bool(launch.forward(job)[1][:, :-1].any()) == meets, "layers that meet"
    for one, other in zip(*results, strict=True):
        assert all(torch.equal(t, other[f]) for f, t in one.items())


def test_adjoints_do_not_depend_on_how_many_substeps_are_kept():
    job = job_of(make_sheet())
    with cuda_on_host.replace_device_by_host():
        usual = adjoints(job)
        with patch.object(launch, "MAX_CHUNK_SUBSTEPS", 5):
            other = adjoints(job)
    for f, t in usual.items():
        torch.testing.assert_close(other[f], t, rtol=0, atol=1e-12 * float(t.abs().max()))


def simulated(cloth, times=TIMES):
    """(rollout, gradients by name) of a batch."""
    state, motion = make_perturbed_state(cloth, (2,)), make_opening_motion(times[-1])
    poses = {name: t._replace(pose=t.pose.to(state.x).requires_grad_()) for name, t in motion.items()}
    x = state.x.clone().requires_grad_()
    cloth.requires_grad_(True).zero_grad()
    out = cloth(state._replace(x=x), poses, times)
    (out.x.square().sum() + out.state.d3.square().sum() + 1e-3 * out.wrench["left"].square().sum()).backward()
    named = {"x": x, "pose": poses["right"].pose, **dict(cloth.named_parameters())}
    return out, {name: t.grad for name, t in named.items() if t.grad is not None}


@pytest.mark.slow
@pytest.mark.parametrize(("dtype", "mark"), [(torch.float64, 1e-9), (torch.float32, 1e-3)])
@pytest.mark.parametrize("contact", [tc.Contact(), None])
def test_the_layer(contact, dtype, mark):
    torch.set_default_dtype(dtype)
    cloth = make_sheet(contact=contact).to(dtype)
    known, before = simulated(cloth)
    with elsewhere():
        assert cloth.engine_in_use == "fused"
        out, after = simulated(cloth)
        with torch.no_grad():
            plain = cloth(make_perturbed_state(cloth, (2,)), make_opening_motion(TIMES[-1]), TIMES)
    for one, other in ((known.x, out.x), (known.x, plain.x), (known.wrench["left"], out.wrench["left"])):
        torch.testing.assert_close(other, one, rtol=0, atol=mark * float(one.detach().abs().max()))
    torch.testing.assert_close(out.state.d3, known.state.d3, rtol=0, atol=mark)
    assert set(before) == set(after)
    for name, t in before.items():
        torch.testing.assert_close(after[name], t, rtol=0, atol=10 * mark * float(t.abs().max()), msg=name)


def down():
    """A hand that comes down by 20 mm."""
    pose = torch.eye(4).repeat(3, 1, 1)
    pose[:, 2, 3] = torch.tensor([0.0, -0.01, -0.02])
    return tc.Trajectory(torch.linspace(0.0, TIMES[-1], 3), pose, torch.ones(3, dtype=torch.bool))


def folded(cloth):
    """One half over the other."""
    x = cloth.rest_state().x.clone()
    right = x[:, 0] > 0.1
    x[right, 0], x[right, 2] = 0.2 - x[right, 0], x[right, 2] + 0.004
    return cloth.state(x)


@pytest.mark.slow
def test_layers_that_meet():
    """Folded, pressed by a hand and falling; values and gradients through the cloth."""
    hand = tc.boundaries.Sphere(0.05, (0.0, 0.1, 0.07), moving=True)
    cloth = make_sheet(contact=tc.Contact(), n=17, boundaries={"hand": hand})
    results = []
    for where in (nullcontext(), elsewhere()):
        with where:
            state = folded(cloth)
            x = state.x.clone().requires_grad_()
            cloth.zero_grad()
            v = torch.tensor([0.0, 0.0, -2.0]) * (state.x[:, 2:] > 0)
            out = cloth(state._replace(x=x, v=v), {"hand": down()}, TIMES)
            with torch.no_grad():
                plain = cloth(state._replace(v=v), {"hand": down()}, TIMES).x
            torch.testing.assert_close(plain, out.x, rtol=0, atol=1e-12)
            (out.x[-1].square().sum() + out.state.d3[:, 2].sum()).backward()
        named = {name: p.grad for name, p in cloth.named_parameters() if p.grad is not None}
        results.append({"end": out.x[-1].detach(), "d3": out.state.d3.detach(), "x": x.grad} | named)
    known, there = results
    assert float(known["material.contact_stiffness.raw"].abs()) > 0
    assert set(there) == set(known)
    for name, t in known.items():
        torch.testing.assert_close(there[name], t, rtol=0, atol=1e-7 * float(t.abs().max()), msg=name)


def test_what_diverges_is_told():
    """And its points, which are nowhere, are not gathered in one place."""
    cloth = make_sheet(contact=tc.Contact(), n=17, boundaries={})
    state = folded(cloth)
    state = state._replace(v=1e200 * torch.randn(state.v.shape))
    with elsewhere(), pytest.raises(tc.errors.SimulationDiverged, match="not finite"):
        cloth(state, times=TIMES)


def test_too_many_nodes_are_an_error(monkeypatch):
    cloth = make_sheet(contact=tc.Contact(), n=17, boundaries={})
    small = property(lambda self: 16)
    monkeypatch.setattr(self_test, "matches_cpu", lambda job, rounding: True)  # it has enough for its own
    with (
        elsewhere(),
        patch.object(program_ir.ContactSearch, "node_slots", small),
        pytest.raises(tc.errors.InvalidInput, match="nodes"),
    ):
        cloth(folded(cloth), times=TIMES)


def test_what_it_cannot_do_is_said():
    class Own(tc.effects.Gravity):
        """Perhaps another law."""

    for effects, contact in (({"own": Own()}, None), ({"own": Own()}, tc.Contact())):
        with elsewhere():
            assert "effects.own in torch, on cuda" in make_sheet(effects=effects, contact=contact).engine_in_use
    with elsewhere(), patch.object(launch, "kernels", side_effect=EngineUnavailable("no libnvrtc", "install it")):
        with pytest.warns(UserWarning, match="no libnvrtc: simulations run on the torch reference"):
            assert make_sheet().engine_in_use == "reference (no libnvrtc)"
        with pytest.raises(tc.errors.InvalidInput, match=r"no libnvrtc.*install it"):
            make_sheet(engine="fused")(make_perturbed_state(make_sheet()), make_opening_motion(TIMES[-1]), TIMES)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_device_is_tried_once(dtype, monkeypatch):
    """On a fold that is pressed; one that does something else is not believed."""
    torch.set_default_dtype(dtype)
    cloth = make_sheet(contact=tc.Contact(), n=17).to(dtype)
    tried, forward, agrees = [], launch.forward, self_test.matches_cpu

    def watched(job, rounding):
        tried.append(bool(forward(job)[1][:, :-1].any()))
        return agrees(job, rounding)

    monkeypatch.setattr(self_test, "matches_cpu", watched)
    for _ in range(2):
        with elsewhere():
            for scenes in ((), (2,)):
                cloth(make_perturbed_state(cloth, scenes), make_opening_motion(2e-3), [0.0, 2e-3])
            assert cloth.engine_in_use == "fused"
    assert tried == [True, True], "layers met"

    def wrong(job, keep_masks=True):
        results, masks = forward(job, keep_masks)
        return {f: 1.1 * t for f, t in results.items()}, masks

    def failing(job, keep_masks=True):
        raise RuntimeError("CUDA: an illegal memory access\nat a place")

    for other, said in ((wrong, "is not the CPU's"), (failing, "fails .CUDA: an illegal memory access.")):
        monkeypatch.setattr(launch, "forward", other)
        dispatch._warn_once.cache_clear()
        with elsewhere():
            with pytest.warns(UserWarning, match=f"the engine on cpu {said}: simulations run on the torch reference"):
                cloth(make_perturbed_state(cloth), make_opening_motion(2e-3), [0.0, 2e-3])
            cloth(make_perturbed_state(cloth), make_opening_motion(2e-3), [0.0, 2e-3])
            assert cloth.engine_in_use.startswith("reference (the engine on cpu ")
    assert len(tried) == 2 + 2 * dispatch.SELF_TEST_SEEDS


@pytest.mark.parametrize("contact", [tc.Contact(), None])
@pytest.mark.parametrize("n", [4, 9, 10])
@pytest.mark.parametrize("offset", [0.0, 3.0])
def test_rounding_is_no_reason_to_doubt_a_device(monkeypatch, contact, n, offset):
    """Plastic cloth far from the origin in float32, on a device that rounds positions in another way."""
    torch.set_default_dtype(torch.float32)
    mesh = tc.meshes.rectangle(0.3, 0.3, resolution=(n, n))
    mesh = tc.meshes.Mesh.build(mesh.vertices + offset, mesh.faces, mesh.uv)
    cloth = tc.Cloth(mesh, tc.materials.AEP(5e4, plastic=tc.materials.NormYield(0.02)), 0.2, contact=contact)

    def rounded(job, keep_masks=True):
        x, _ = next((f, t) for f, t in job.inputs.items() if f.kind == enums.FieldKind.STATE)
        noise = 0.3 * torch.finfo(torch.float32).eps * torch.randn_like(job.inputs[x])
        job = job._replace(inputs={**job.inputs, x: job.inputs[x] * (1 + noise)})
        return execution.forward(job)[0], torch.zeros(0)

    def reverse(job, masks, seeds, wanted, chunk):
        return execution.reverse(job, execution.forward(job, 1)[1], 1, seeds, wanted)

    monkeypatch.setattr(launch, "forward", rounded)
    monkeypatch.setattr(launch, "reverse", reverse)
    model, agreed = cloth.build_model(), []
    dt = cloth.stable_step() / 2
    begin = partial(random_contact_state, model, cloth.rest_state().x, dispatch.SELF_TEST_SUBSTEPS * dt)
    with patch.object(devices, "is_on_device", lambda tensor: True):
        rounding = FusedEngine(model, cloth.rest_state(), dispatch.stationary_prescribed(model)).rounding
        for job in dispatch._self_test_jobs(model, torch.Size(), dispatch.SelfTest(begin, dt)):
            agreed.append(self_test.matches_cpu(job, rounding))
    assert all(agreed)


def test_directions_are_the_references():
    cloth = make_sheet()
    along = tc.Directions({"areal_density.raw": torch.ones(1)})
    known = cloth.sensitivities(make_perturbed_state(cloth), make_opening_motion(TIMES[-1]), TIMES, along=along)[1]
    with elsewhere():
        results = cloth.sensitivities(make_perturbed_state(cloth), make_opening_motion(TIMES[-1]), TIMES, along=along)[
            1
        ]
    torch.testing.assert_close(results.x, known.x, rtol=0, atol=1e-7 * float(known.x.abs().max()))


def test_every_kernel_can_be_written_down():
    for name, (number, takes, gives) in kernels().items():
        kernel = kernel_codegen.kernel(number)
        assert len(kernel.out) == gives, name
        lines = list(kernel.values("n", [f"r{k}" for k in range(takes)]))
        lines += kernel.adjoints("n", ["g"] * gives, [f"b{k}" for k in range(takes)])
        assert all(line.endswith(";") and "{" not in line for line in lines), name


def test_what_does_not_compile_is_tried_once():
    launch._compile_once.cache_clear()
    device = torch.device("cpu")
    with patch.object(launch, "DeviceKernels", side_effect=EngineUnavailable("NVRTC: no", "report it")) as tried:
        for _ in range(2):
            with pytest.raises(EngineUnavailable, match="NVRTC: no"):
                launch.kernels("text", device)
        assert tried.call_count == 1
    launch._compile_once.cache_clear()


def test_masks_are_bits():
    masks = (torch.rand(2, 3, 29) < 0.5).to(torch.uint8)[:, 0]
    bits = launch._pack_bits(masks)
    assert bits.shape == (2, 4)
    assert torch.equal(launch._unpack_bits(bits, 29), masks)
    assert launch._pack_bits(masks[:, :0]).shape == (2, 0)
