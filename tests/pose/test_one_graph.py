"""A network's answer, the fabric and the joint angles of an arm in one graph: one backward pass reaches all three."""

from __future__ import annotations

import pytest
import torch
from torch.func import functional_call

import torchcloth as tc
from torchcloth.losses import chamfer_to_surface
from torchcloth.pose.network import PoseEstimator, PoseNetworkConfig
from torchcloth.pose.scene_frame import PoseInputs, rest_coordinates

SMALL = PoseNetworkConfig(width=16, heads=2, point_blocks=1, latents=4, vertex_blocks=1, refinements=1, hypotheses=1)
STEP = 1e-5


@pytest.fixture(scope="module")
def graph():
    """The loss as a function of network weights, fabric and joint waypoints; and where it is evaluated."""
    torch.manual_seed(0)
    mesh = tc.meshes.rectangle(0.2, 0.2, triangles=50)
    cloth = tc.Cloth(
        mesh,
        tc.materials.AEP(youngs_modulus=4e4, poisson_ratio=0.3, thickness=1e-3),
        areal_density=0.25,
        effects={"gravity": tc.effects.Gravity(), "air": tc.effects.AirDrag(1.2), "bending": tc.effects.Bending(5e-5)},
        boundaries={"hand": tc.boundaries.Grasp.corner("upper-left")},
        contact=None,
    ).double()
    network = PoseEstimator(SMALL).double()
    arm = tc.robots.load("rizon4", frame="tcp_closed")
    q = arm.home.double().expand(3, 7) + 0.02 * torch.randn(3, 7).double()
    t = torch.tensor([0.0, 0.05, 0.1], dtype=torch.float64)
    hand = arm.motion(q, t).pose[0, :3, 3].detach()
    rest = rest_coordinates(mesh).double()
    hanging = torch.stack([rest[:, 0], 0 * rest[:, 0], rest[:, 1] - 0.2], -1) + hand
    cloud = (hanging + 0.005 * torch.randn_like(hanging)).detach()
    grip = torch.zeros(len(rest), dtype=torch.int64)
    grip[cloth.boundaries["hand"].index] = 1
    nothing = torch.full((1, 3), torch.nan).double()
    inputs = PoseInputs(
        cloud[None],
        rest[None],
        torch.ones(1, len(rest), dtype=torch.bool),
        grip[None],
        torch.cat([hand[None], nothing])[None],
        torch.zeros(1, 2, 3).double(),
        torch.full((1, len(rest), 3), torch.nan).double(),
    )
    faces, goal = torch.as_tensor(mesh.faces), hand + torch.tensor([0.1, 0.0, -0.1]).double()

    def loss(weights, log_modulus, q):
        prediction = functional_call(network, weights, (inputs,))
        state = cloth.state(prediction.x[0], prediction.v[0])
        arguments = (state, {"hand": arm.motion(q, t)})
        out = functional_call(cloth, {"material.youngs_modulus.raw": log_modulus}, arguments, {"times": t})
        data = chamfer_to_surface(cloud, out.x[1], faces)
        return 100 * data + 10 * (out.x[-1].mean(0) - goal).square().sum()

    # of the answer: not of the fabric's parameters, nor of the scale of the standard deviations
    weights = {name: value.detach() for name, value in network.named_parameters()}
    return loss, weights, cloth.material.youngs_modulus.raw.detach().clone(), q


def test_gradients_of_all_three_agree_with_finite_differences(graph):
    loss, weights, log_modulus, q = graph
    leaves = [value.clone().requires_grad_() for value in weights.values()]
    log_modulus, q = log_modulus.clone().requires_grad_(), q.clone().requires_grad_()
    value = loss(dict(zip(weights, leaves, strict=True)), log_modulus, q)
    gradients = torch.autograd.grad(value, [*leaves, log_modulus, q], allow_unused=True)
    generator = torch.Generator().manual_seed(4)
    directions = [torch.randn(leaf.shape, generator=generator).double() for leaf in leaves]

    def directional(gradients, directions):
        pairs = zip(gradients, directions, strict=True)
        return float(sum((g * d).sum() for g, d in pairs if g is not None))

    def difference(weight_step, modulus_step, joint_step):
        ends = []
        for sign in (1, -1):
            moved = [w + sign * STEP * weight_step * d for w, d in zip(leaves, directions, strict=True)]
            with torch.no_grad():
                arguments = log_modulus + sign * STEP * modulus_step, q + sign * STEP * joint_step
                ends.append(float(loss(dict(zip(weights, moved, strict=True)), *arguments)))
        return (ends[0] - ends[1]) / (2 * STEP)

    joint_direction = torch.randn(q.shape, generator=generator).double()
    assert directional(gradients[:-2], directions) == pytest.approx(difference(1.0, 0.0, 0.0), rel=1e-5)
    assert float(gradients[-2]) == pytest.approx(difference(0.0, 1.0, 0.0), rel=1e-5)
    assert float((gradients[-1] * joint_direction).sum()) == pytest.approx(
        difference(0.0, 0.0, joint_direction), rel=1e-5
    )


def test_none_of_the_three_gradients_is_zero(graph):
    loss, weights, log_modulus, q = graph
    leaves = [value.clone().requires_grad_() for value in weights.values()]
    log_modulus, q = log_modulus.clone().requires_grad_(), q.clone().requires_grad_()
    loss(dict(zip(weights, leaves, strict=True)), log_modulus, q).backward()
    assert sum(float(leaf.grad.norm()) for leaf in leaves if leaf.grad is not None) > 1e-3
    assert abs(float(log_modulus.grad)) > 1e-6
    assert float(q.grad.norm()) > 1e-3
