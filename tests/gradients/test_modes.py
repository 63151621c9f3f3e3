"""Ways to compute the same thing: forward and reverse mode, checkpoints, batches, precisions."""

from contextlib import nullcontext

import pytest
import torch
import torch.autograd.forward_ad as forward_ad
from helpers.gradient_scenes import active_parameters, simulate

from torchcloth._utils.forward_mode import dense_tangents
from torchcloth.testing.contract import batch_parameters, require_close, unbatch_parameters


@pytest.fixture(params=["swing", "pressed"])
def scene(request):
    return request.getfixturevalue(request.param)


def run(scene, values, state, motion, **options):
    out = simulate(scene.cloth, values, state, motion, scene.times, dt=scene.dt, **options)
    parts = [out.x[..., 1:, :, :].flatten(-3), out.v[..., 1:, :, :].flatten(-3)]
    parts += [out.state.d3.flatten(-2)] if "d3" in leaves_of(scene) else []
    return torch.cat([*parts, *(w[..., 1:, :].flatten(-2) for w in out.wrench.values())], dim=-1)


def leaves_of(scene):
    leaves = {**active_parameters(scene.cloth), "x": scene.state.x, "v": scene.state.v}
    if scene.cloth.contact is not None:
        leaves["d3"] = scene.state.d3
    return {**leaves, **{name: trajectory.pose for name, trajectory in scene.motion.items()}}


def evaluate(scene, leaves, **options):
    values = dict(leaves)
    state = scene.state._replace(x=values.pop("x"), v=values.pop("v"), d3=values.pop("d3", scene.state.d3))
    motion = {name: trajectory._replace(pose=values.pop(name)) for name, trajectory in scene.motion.items()}
    return run(scene, values, state, motion, **options)


def test_forward_mode_equals_reverse_mode(scene):
    """<w, J u> both ways for every input apart; 1e-10: a thousand operations at 1e-16 with some cancellation."""
    torch.manual_seed(3)
    inputs = leaves_of(scene)
    leaves = {name: value.clone().requires_grad_() for name, value in inputs.items()}
    out = evaluate(scene, leaves)
    weight = torch.randn_like(out)
    gradients = dict(zip(leaves, torch.autograd.grad((weight * out).sum(), list(leaves.values())), strict=True))
    for name, value in inputs.items():
        along = torch.randn_like(value)
        with torch.no_grad(), forward_ad.dual_level(), dense_tangents():
            dual = forward_ad.make_dual(value, along)
            tangent = forward_ad.unpack_dual(evaluate(scene, {**inputs, name: dual}, checkpoint=False)).tangent
        reverse, forward = (gradients[name] * along).sum(), (weight * tangent).sum()
        size = (weight * tangent).abs().sum()
        assert float((reverse - forward).abs()) <= 1e-10 * float(size), name


def test_real_tangents_change_nothing(scene):
    inputs = leaves_of(scene)
    values = []
    for inside in (False, True):
        with torch.no_grad(), forward_ad.dual_level():
            duals = dict(inputs)
            for name in active_parameters(scene.cloth):
                duals[name] = forward_ad.make_dual(inputs[name], torch.ones_like(inputs[name]))
            with dense_tangents() if inside else nullcontext():
                dual = evaluate(scene, duals, checkpoint=False)
            values.append(forward_ad.unpack_dual(dual))
    require_close(values[1].primal, values[0].primal, 1e-13, "values")
    require_close(values[1].tangent, values[0].tangent, 1e-11, "tangents")


def test_checkpoints_change_nothing(scene):
    """Bitwise in values; gradients add up in another order: 1e-12."""
    gradients = []
    for checkpoint in (True, False):
        leaves = {name: value.clone().requires_grad_() for name, value in leaves_of(scene).items()}
        out = evaluate(scene, leaves, checkpoint=checkpoint)
        gradients.append((out.detach(), torch.autograd.grad(out.pow(2).sum(), list(leaves.values()))))
    assert torch.equal(gradients[0][0], gradients[1][0])
    for name, a, b in zip(leaves_of(scene), gradients[0][1], gradients[1][1], strict=True):
        require_close(a, b, 1e-12, name)


def test_checkpoints_within_long_intervals(swing):
    """More than one chunk of substeps between two frames."""
    swing.times = [0.0, 130 * swing.dt]
    swing.motion = {"hand": swing.motion["hand"]._replace(t=torch.linspace(0.0, swing.times[-1], 4))}
    test_checkpoints_change_nothing(swing)


def test_a_batch_equals_a_loop(scene):
    """States, poses and parameters at once, values and gradients."""
    names = active_parameters(scene.cloth)
    many = batch_parameters(names, 3, spread=0.05)
    torch.manual_seed(0)
    fields = {name: value for name, value in leaves_of(scene).items() if name not in names}
    spread = {"x": 1e-3, "v": 0.1, "d3": 1e-2}
    inputs = dict(many)
    for name, value in fields.items():
        inputs[name] = value + spread.get(name, 0.0) * torch.randn(3, *value.shape)
    for name in scene.motion:
        shift = torch.zeros_like(inputs[name])
        shift[..., :3, 3] = 0.01 * torch.randn(3, 1, 3) * torch.linspace(0, 1, 4)[:, None]
        inputs[name] = inputs[name] + shift
    leaves = {name: value.clone().requires_grad_() for name, value in inputs.items()}
    together = evaluate(scene, leaves)
    gradients = dict(zip(leaves, torch.autograd.grad(together.pow(2).sum(), list(leaves.values())), strict=True))
    for k in range(3):
        one = {**unbatch_parameters(many, names, k), **{name: inputs[name][k] for name in fields}}
        one = {name: value.clone().requires_grad_() for name, value in one.items()}
        alone = evaluate(scene, one)
        require_close(together[k], alone, 1e-12, f"entry {k}")
        for name, gradient in zip(one, torch.autograd.grad(alone.pow(2).sum(), list(one.values())), strict=True):
            require_close(gradients[name][k].reshape(gradient.shape), gradient, 1e-11, f"gradient of {name}, entry {k}")


def test_float32_agrees_with_float64(scene):
    """1e-4: 40 substeps of a state with 1e-7 relative precision; no NaN in any gradient."""
    exact = evaluate(scene, leaves_of(scene)).detach()
    scene.cloth.float()
    scene.state = scene.state.map(lambda field: field.float())
    leaves = {name: value.float().requires_grad_() for name, value in leaves_of(scene).items()}
    out = evaluate(scene, leaves)
    assert out.dtype == torch.float32
    frames = 6 * len(scene.cloth.mesh.vertices) * (len(scene.times) - 1)
    require_close(out[:frames].double(), exact[:frames], 1e-4, "positions and velocities")
    for name, gradient in zip(leaves, torch.autograd.grad(out.pow(2).sum(), list(leaves.values())), strict=True):
        assert torch.isfinite(gradient).all(), name


@pytest.mark.parametrize(
    ("scene_name", "what"), [("swing", "poses"), ("swing", "parameters"), ("pressed", "parameters")]
)
def test_one_state_with_batched_poses_or_parameters(request, scene_name, what):
    """One initial state, many motions or many fabrics: what planning and identification ask for."""
    scene = request.getfixturevalue(scene_name)
    leaves = leaves_of(scene)
    torch.manual_seed(0)
    if what == "poses":
        many = {name: leaves[name].repeat(3, 1, 1, 1) for name in scene.motion}
        for poses in many.values():
            poses[..., :3, 3] += 0.01 * torch.randn(3, 1, 3) * torch.linspace(0, 1, poses.shape[1])[:, None]
        entries = [{name: poses[k] for name, poses in many.items()} for k in range(3)]
    else:
        names = active_parameters(scene.cloth)
        many = batch_parameters(names, 3, spread=0.05)
        entries = [unbatch_parameters(many, names, k) for k in range(3)]
    together = evaluate(scene, {**leaves, **many})
    for k, entry in enumerate(entries):
        require_close(together[k], evaluate(scene, {**leaves, **entry}), 1e-12, f"entry {k}")
    assert not torch.allclose(together[0], together[1])
