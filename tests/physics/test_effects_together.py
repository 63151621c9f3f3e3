"""All effects that are not bending, at once: one rollout's derivatives, batches and precision."""

import pytest
import torch
from torch.func import functional_call, jvp

import torchcloth as tc
from torchcloth.testing import check_gradients

T = torch.tensor([0.0, 0.004], dtype=torch.float64)


def everything():
    effects = {
        "gravity": tc.effects.Gravity(tilt=(0.02, -0.03)),
        "air": tc.effects.AirDrag(1.2, tangential=0.02, wind=(0.3, 0.1, 0.2)),
        "added": tc.effects.AddedMass(0.1),
        "viscous": tc.effects.KelvinVoigt(0.2),
        "hem": tc.effects.LineMass(0.005),
        "rest": tc.effects.RestShape(0.02, -0.01, 0.03),
        "slip": tc.effects.GripSlip("hand", 0.02, 0.05),
    }
    mesh = tc.meshes.rectangle(0.3, 0.2, resolution=(4, 4))
    grasp = {"hand": tc.boundaries.Grasp([0, 1, 4])}
    return tc.Cloth(mesh, tc.materials.AEP(1e5, 0.3), 0.2, effects, grasp, contact=None)


def start(cloth):
    torch.manual_seed(0)
    return cloth.rest_state().x + 0.004 * torch.randn(16, 3), torch.randn(16, 3)


def motion(dtype=torch.float64):
    pose = torch.eye(4, dtype=dtype).repeat(2, 1, 1)
    pose[1, 2, 3] = 0.006
    return {"hand": tc.Trajectory(T.to(dtype), pose, torch.ones(2, dtype=bool))}


@pytest.fixture
def run():
    """(amplitudes by name, run(**amplitudes) -> rollout) of one cloth with one state and step."""
    cloth = everything()
    state, dt = cloth.state(*start(cloth)), 0.7 * cloth.stable_step()
    amplitudes = {name: p.detach() for name, p in cloth.named_parameters() if name.startswith("effects.")}
    return amplitudes, lambda **moved: functional_call(cloth, moved, (state, motion(), T), {"dt": dt})


def read(out):
    return torch.cat([out.x[-1].flatten(), 1e-2 * out.v[-1].flatten(), 1e-2 * out.wrench["hand"][-1]])


def test_derivatives_forward_backward_and_by_differences(run):
    amplitudes, simulate = run
    torch.manual_seed(1)
    ways = {name: torch.randn_like(p) * (p.abs().mean() + 1e-3) for name, p in amplitudes.items()}

    def along(way):
        return read(simulate(**{name: p + way * 0.1 * ways[name] for name, p in amplitudes.items()}))

    check_gradients(along, {"way": torch.zeros(())}, 1e-7)
    value, forward = jvp(along, (torch.zeros(()),), (torch.ones(()),))
    weight = torch.randn_like(value)
    leaves = {name: p.clone().requires_grad_() for name, p in amplitudes.items()}
    gradients = torch.autograd.grad((read(simulate(**leaves)) * weight).sum(), list(leaves.values()))
    assert all(g.abs().max() > 0 for g in gradients)
    backward = sum((0.1 * ways[name] * g).sum() for name, g in zip(leaves, gradients, strict=True))
    torch.testing.assert_close(backward, weight @ forward, rtol=1e-9, atol=0)


def test_a_batch_of_amplitudes_is_a_loop(run):
    amplitudes, simulate = run
    factor = 1 + 0.1 * torch.linspace(-1, 1, 3)
    many = {name: factor.reshape(-1, *[1] * max(1, p.ndim)) * p for name, p in amplitudes.items()}
    with torch.no_grad():
        together = simulate(**many)
        for k in range(3):
            alone = simulate(**{name: value[k].reshape(amplitudes[name].shape) for name, value in many.items()})
            torch.testing.assert_close(together.x[k], alone.x, rtol=0, atol=1e-14)
            torch.testing.assert_close(together.wrench["hand"][k], alone.wrench["hand"], rtol=1e-10, atol=1e-12)
    assert (together.x[0] - together.x[2]).abs().max() > 1e-5


def test_single_precision():
    cloth = everything()
    x, v = start(cloth)
    with torch.no_grad():
        exact = cloth(cloth.state(x, v), motion(), T)
        out = cloth.float()(cloth.state(x.float(), v.float()), motion(torch.float32), T)
    assert out.x.dtype == out.wrench["hand"].dtype == torch.float32
    torch.testing.assert_close(out.x.double(), exact.x, rtol=0, atol=1e-6)


@pytest.mark.parametrize("contact", [None, tc.Contact(everywhere=True)])
def test_no_law_depends_on_the_winding_of_the_triangles(contact):
    """Bar rest curvature, which is to the side of the normal: turned over with the normal, it has the other sign."""
    plain = tc.meshes.rectangle(0.3, 0.2, resolution=(5, 4))
    turned = tc.meshes.Mesh.build(plain.vertices, plain.faces[:, ::-1], plain.uv)
    ends = []
    for mesh, side in ((plain, 1.0), (turned, -1.0)):
        effects = {
            "gravity": tc.effects.Gravity(),
            "air": tc.effects.AirDrag(1.2, tangential=0.02, wind=(0.3, 0.1, 0.2)),
            "added": tc.effects.AddedMass(0.1),
            "viscous": tc.effects.KelvinVoigt(0.2),
            "bending": tc.effects.Bending(
                3e-5, weft_ratio=0.3, twist_ratio=2.0, curl_warp=3.0 * side, curl_weft=-1.0 * side
            ),
            "creases": tc.effects.CreasingBending(2e-5, mobility=0.1),
            "saturating": tc.effects.SaturatingBending(1e-4),
            "friction": tc.effects.BendingFriction(1e-4),
            "shear": tc.effects.ShearFriction(0.5),
            "rest": tc.effects.RestShape(0.02, -0.01, 0.03),
        }
        plastic = tc.materials.NormYield(0.02)
        material = tc.materials.OrthotropicAEP(1e5, weft_modulus=3e4, shear_modulus=4e3, plastic=plastic)
        cloth = tc.Cloth(mesh, material, 0.2, effects, {"hand": tc.boundaries.Grasp([0, 4])}, contact)
        still = tc.Trajectory(T, torch.eye(4, dtype=T.dtype).repeat(2, 1, 1), torch.ones(2, dtype=bool))
        torch.manual_seed(0)
        state = cloth.state(cloth.rest_state().x + 0.004 * torch.randn(20, 3), torch.randn(20, 3))
        with torch.no_grad():
            out = cloth(state, {"hand": still}, T, dt=5e-5)
        ends.append(read(out))
    torch.testing.assert_close(ends[1], ends[0], rtol=0, atol=1e-9)
