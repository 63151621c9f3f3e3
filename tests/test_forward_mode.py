"""``dense_tangents``: same values and tangents, and the reason why it exists."""

import time
from contextlib import nullcontext

import pytest
import torch
import torch.autograd.forward_ad as forward_ad

import torchcloth as tc
from torchcloth._utils.forward_mode import dense_tangents

OPERATIONS = {
    "mul": torch.mul,
    "*": lambda a, b: a * b,
    "method mul": lambda a, b: a.mul(b),
    "add": torch.add,
    "+": lambda a, b: a + b,
    "sub": torch.sub,
    "-": lambda a, b: a - b,
    "div": torch.div,
    "/": lambda a, b: a / b,
}
SHAPES = [((4, 3), (4, 3)), ((5, 4, 3), (4, 1)), ((4, 1), (5, 4, 3)), ((4, 3), ()), ((), (4, 3)), ((3,), (4, 3))]


def evaluate(operation, a, b, tangent_a, tangent_b, inside):
    with forward_ad.dual_level(), dense_tangents() if inside else nullcontext():
        a = a if tangent_a is None else forward_ad.make_dual(a, tangent_a)
        b = b if tangent_b is None else forward_ad.make_dual(b, tangent_b)
        out = forward_ad.unpack_dual(operation(a, b))
        return out.primal.clone(), None if out.tangent is None else out.tangent.clone()


def same(operation, a, b, tangent_a, tangent_b):
    plain = evaluate(operation, a, b, tangent_a, tangent_b, False)
    inside = evaluate(operation, a, b, tangent_a, tangent_b, True)
    assert torch.equal(plain[0], inside[0])
    if plain[1] is None:
        assert inside[1] is None
    else:
        assert torch.equal(plain[1], inside[1])
        assert plain[1].shape == inside[1].shape


@pytest.mark.parametrize("mixed", ["first", "second", "both", "neither"])
@pytest.mark.parametrize("shapes", SHAPES, ids=str)
@pytest.mark.parametrize("name", OPERATIONS)
def test_two_tensors(name, shapes, mixed):
    torch.manual_seed(0)
    a, b = torch.randn(shapes[0]), 2 + torch.rand(shapes[1])
    tangent_a = torch.randn_like(a) if mixed in ("first", "both") else None
    tangent_b = torch.randn_like(b) if mixed in ("second", "both") else None
    same(OPERATIONS[name], a, b, tangent_a, tangent_b)


@pytest.mark.parametrize("scalar", [2, 2.5, -1.0])
@pytest.mark.parametrize(
    "operation",
    [*OPERATIONS.values(), lambda a, s: s * a, lambda a, s: s + a, lambda a, s: s - a, lambda a, s: s / a, torch.rsub],
)
def test_scalars(operation, scalar):
    torch.manual_seed(0)
    a, tangent = 2 + torch.rand(4, 3), torch.randn(4, 3)
    same(operation, a, scalar, tangent, None)


@pytest.mark.parametrize("mixed", ["first", "second", "both"])
@pytest.mark.parametrize(
    "shapes", [((4, 3), (3, 2)), ((5, 4, 3), (3, 2)), ((5, 4, 3), (5, 3, 3)), ((3, 3), (3,))], ids=str
)
def test_matmul(shapes, mixed):
    torch.manual_seed(0)
    a, b = torch.randn(shapes[0]), torch.randn(shapes[1])
    tangent_a = torch.randn_like(a) if mixed != "second" else None
    tangent_b = torch.randn_like(b) if mixed != "first" else None
    for operation in (torch.matmul, lambda a, b: a @ b):
        same(operation, a, b, tangent_a, tangent_b)


def test_keywords_expanded_operands_and_precisions():
    a, b = torch.randn(4, 3), torch.randn(1, 3).expand(4, 3)
    same(lambda a, b: torch.add(a, b, alpha=2.0), a, b, torch.randn(4, 3), None)
    same(lambda a, b: a * b, a, b, torch.randn(4, 3), None)
    same(lambda a, b: a * b.mT.contiguous().mT, a, b, torch.randn(4, 3), None)
    for dtype in (torch.float32, torch.float64):
        same(lambda a, b: a / b, a.to(dtype), b.to(dtype), torch.randn(4, 3, dtype=dtype), None)


@pytest.mark.parametrize("other", [torch.arange(3), torch.tensor([True, False, True])], ids=["int", "bool"])
def test_integer_operands(other):
    same(lambda a, b: a * b, torch.randn(4, 3), other, torch.randn(4, 3), None)


def test_operands_are_left_as_they_were():
    a, b = torch.randn(4, 3), torch.randn(4, 3)
    with forward_ad.dual_level():
        dual = forward_ad.make_dual(a, torch.ones_like(a))
        with dense_tangents():
            dual * b
        assert forward_ad.unpack_dual(b).tangent is None


def test_is_needed():
    """A mixed product in a substep of 30 triangles; best of several rounds, so that a busy machine does not decide."""
    a, b, tangent = torch.randn(32, 3), torch.randn(32, 3), torch.randn(32, 3)

    def seconds(context):
        with torch.no_grad(), forward_ad.dual_level(), context:
            dual = forward_ad.make_dual(a, tangent)
            rounds = []
            for _ in range(7):
                start = time.perf_counter()
                for _ in range(60):
                    dual * b
                rounds.append(time.perf_counter() - start)
        return min(rounds)

    plain, inside = seconds(nullcontext()), seconds(dense_tangents())
    if plain < 40e-6 * 60 and plain < 3 * inside:
        pytest.skip(
            f"torch {torch.__version__} multiplies mixed operands fast by itself: dense_tangents can be retired"
        )
    assert plain > 3 * inside


@pytest.mark.parametrize("engine", ["fused", "reference"])
def test_one_direction_in_inference_mode(engine):
    """Views of what was made there keep no tangent: derivatives were 0."""

    def moved():
        hand = {"hand": tc.boundaries.Grasp([0])}
        mesh = tc.meshes.rectangle(0.1, 0.1, resolution=(4, 4))
        cloth = tc.Cloth(mesh, tc.materials.AEP(3e4), 0.2, {"g": tc.effects.Gravity()}, hand, None, engine=engine)
        t = torch.tensor([0.0, 0.01])
        motion = {"hand": tc.Trajectory(t, torch.eye(4).repeat(2, 1, 1), torch.tensor([True, True]))}
        lift = torch.zeros(1, 2, 4, 4)
        lift[:, 1, 2, 3] = 1.0
        one = {"areal_density.raw": torch.ones(1), "material.youngs_modulus.raw": torch.ones(1)}
        both = (tc.Directions(one), tc.Directions(motion={"hand": lift}))
        return [cloth.sensitivities(cloth.rest_state(), motion, t, along=along)[1].x for along in both]

    outside = moved()
    with torch.inference_mode():
        inside = moved()
    for one, other in zip(outside, inside, strict=True):
        assert float(one.norm()) > 0
        torch.testing.assert_close(other.clone(), one)


def test_jvp_of_numbers_in_float32():
    """torch.func.jvp makes a float64 tangent of a Python number times a scalar: its bits were read as float32."""
    hand = {"hand": tc.boundaries.Grasp([0])}
    mesh = tc.meshes.rectangle(0.1, 0.1, resolution=(5, 5))
    cloth = tc.Cloth(mesh, tc.materials.AEP(3e4, 0.3), 0.2, {"g": tc.effects.Gravity()}, hand, None).float()
    t = torch.tensor([0.0, 0.05])
    motion = {"hand": tc.Trajectory(t, torch.eye(4).repeat(2, 1, 1), torch.tensor([True, True]))}
    state, name = cloth.rest_state(), "material.poisson_ratio.raw"

    def loss(raw):
        return torch.func.functional_call(cloth, {name: raw}, (state, motion, t)).x[-1].square().sum()

    raw = cloth.material.poisson_ratio.raw.detach()
    parameter = raw.clone().requires_grad_()
    loss(parameter).backward()
    assert float(torch.func.jvp(loss, (raw,), (torch.ones_like(raw),))[1].detach()) == pytest.approx(
        float(parameter.grad), rel=1e-3
    )
