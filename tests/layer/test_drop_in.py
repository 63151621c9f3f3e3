"""What people do with a module of torch's, done to a cloth."""

import copy
import time

import pytest
import torch
from helpers.small_sheet import make_sheet
from torch import nn
from torch.func import functional_call

import torchcloth as tc
from torchcloth.effects import AbstractEffect
from torchcloth.errors import InvalidInput

ENGINES = ["fused", "reference"]
GLOO_THREAD_S = 0.3  # in which gloo's thread drops the work that it has done


class Learned(AbstractEffect):
    """A force by a network."""

    def __init__(self, *layers):
        super().__init__()
        self.network = nn.Sequential(nn.Linear(3, 4), nn.Tanh(), *layers, nn.Linear(4, 3))

    def coefficients(self):
        return None

    def force(self, c, inputs):
        return 0.02 * self.network(inputs.v + inputs.x)


def gripped(effects=None, engine="auto"):
    cloth = make_sheet(effects=effects, boundaries={"hand": tc.boundaries.Grasp.corner("upper-left")})
    cloth.engine = engine
    t = torch.linspace(0.0, 0.04, 5)
    pose = torch.eye(4).repeat(5, 1, 1)
    pose[:, 2, 3] = 0.5 * t
    return cloth, {"hand": tc.Trajectory(t, pose, torch.ones(5, dtype=torch.bool))}


def loss_of(cloth, motion, **options):
    return cloth(cloth.rest_state(), motion, times=(0.0, 0.04), **options).x[-1].square().sum()


# -- optimisers ------------------------------------------------------------------------------------------------------


def test_a_step_below_zero_is_refused_by_name_and_can_be_taken_back():
    cloth, motion = gripped({"bending": tc.effects.Bending(1e-4), "damping": tc.effects.MassDamping(1e-4)})
    optimiser = torch.optim.Adam(cloth.parameters(), lr=1e-2)
    loss_of(cloth, motion).backward()
    optimiser.step()
    with pytest.raises(InvalidInput, match=r"effects\.(bending|damping)\..*; expected a value >= 0; call .*clip_"):
        loss_of(cloth, motion)
    assert "expected a value >= 0" in repr(cloth)  # which is how one looks for what is wrong
    cloth.clip_()
    assert float(cloth.effects["bending"].stiffness.value.detach()) >= 0.0
    assert loss_of(cloth, motion).isfinite()


def facts(cloth):
    air, gravity, ball = cloth.effects["air"], cloth.effects["gravity"], cloth.boundaries["ball"]
    return [gravity.acceleration, gravity.tilt, air.wind, ball.radius.raw, cloth.boundaries["box"].size.raw]


@pytest.mark.parametrize("engine", ENGINES)
def test_an_optimiser_of_all_parameters_leaves_the_world_alone(engine):
    """Reported: thirty steps learned a gravity of (-0.09, 0.26, -10.10) m/s^2, its tilt and a wind."""
    effects = {"gravity": tc.effects.Gravity(), "air": tc.effects.AirDrag()}
    cloth, motion = gripped(effects, engine)
    cloth.boundaries["ball"] = tc.boundaries.Sphere(0.05, (0.1, 0.1, -0.06))
    cloth.boundaries["box"] = tc.boundaries.Box((0.1, 0.1, 0.1))
    before = [fact.detach().clone() for fact in facts(cloth)]
    optimiser = torch.optim.Adam(cloth.parameters(), lr=1e-2)
    loss_of(cloth, motion).backward()
    optimiser.step()
    assert all(torch.equal(fact, value) for fact, value in zip(facts(cloth), before, strict=True))
    assert float(cloth.effects["air"].normal.value.detach()) != 1.2
    cloth.clip_()
    for fact in facts(cloth):
        fact.requires_grad_()
    loss_of(cloth, motion).backward()
    assert all(fact.grad is not None for fact in facts(cloth))
    cloth.require_default_gradients_()
    assert not any(fact.requires_grad for fact in facts(cloth))


@pytest.mark.parametrize("engine", ENGINES)
def test_data_parallel_training_waits_for_no_parameter_that_cannot_act(engine, tmp_path):
    """Reported: without contact, the second step complained of parameters that were not used."""
    effects = {"gravity": tc.effects.Gravity(), "air": tc.effects.AirDrag()}
    cloth, motion = gripped(effects, engine)
    torch.distributed.init_process_group("gloo", init_method=f"file://{tmp_path}/store", rank=0, world_size=1)
    try:
        parallel = nn.parallel.DistributedDataParallel(cloth)
        for _ in range(3):
            parallel(cloth.rest_state(), motion, times=(0.0, 0.04)).x[-1].square().sum().backward()
        # torch joins gloo's thread with Python's lock held; that thread may still need it for its last work
        time.sleep(GLOO_THREAD_S)
    finally:
        torch.distributed.destroy_process_group()
    assert all(p.grad is not None for p in cloth.parameters() if p.requires_grad)
    assert not cloth.material.contact_stiffness.raw.requires_grad


def test_contact_lets_its_parameters_be_learned():
    for contact, learned in ((None, False), (tc.Contact(), True)):
        cloth = make_sheet(contact=contact)
        for again in (cloth, copy.deepcopy(cloth), cloth.requires_grad_(True).require_default_gradients_()):
            material = again.material
            for parameter in (material.contact_stiffness, material.shear_stiffness, material.cone):
                assert parameter.raw.requires_grad is learned
            assert material.youngs_modulus.raw.requires_grad


def test_a_state_is_the_callers():
    cloth, _ = gripped()
    cloth.rest_state().x.add_(0.5)
    assert float(cloth.rest_state().x[:, 2].abs().max()) == 0.0
    assert float(torch.as_tensor(cloth.mesh.vertices)[:, 2].abs().max()) == 0.0
    cloth.requires_grad_(False)
    cloth.rest_state().x.requires_grad_()
    assert not cloth.rest_state().x.requires_grad


# -- modules ---------------------------------------------------------------------------------------------------------


def test_a_checkpoint_carries_what_is_learned_and_no_scene():
    """A fit that is loaded into another experiment must not move its table, nor what is held."""
    of = lambda n, z, corner: make_sheet(  # noqa: E731
        n,
        effects={"sticky": tc.effects.Adhesion(point=(0.0, 0.0, z))},
        boundaries={
            "table": tc.boundaries.Plane(point=(0.0, 0.0, z), friction=tc.boundaries.Elliptic(0.4, 0.2)),
            "ball": tc.boundaries.Sphere(0.1, (0.0, 0.0, z - 1)),
            "hand": tc.boundaries.Grasp.corner(corner),
        },
    )
    one, other = of(5, -0.1, "upper-left"), of(4, -0.5, "lower-right")
    one.material.youngs_modulus.set(7e4)
    before = other.boundaries["hand"].index.clone()
    other.load_state_dict(one.state_dict())
    assert float(other.material.youngs_modulus.value.detach()) == pytest.approx(7e4)
    assert torch.equal(other.boundaries["hand"].index, before)
    assert float(other.boundaries["table"].point[2]) == -0.5
    assert one.state_dict().keys() == dict(one.named_parameters()).keys()


def test_modules_with_a_cloth_can_be_gone_through():
    cloth, _ = gripped()
    seen = []
    nn.Sequential(nn.Linear(2, 2), cloth).apply(lambda part: seen.append(type(part)))
    assert tc.boundaries.Grasp in seen


@pytest.mark.parametrize("engine", ENGINES)
def test_parts_that_come_later_are_bound_as_the_first_ones_are(engine):
    cloth, motion = gripped({"gravity": tc.effects.Gravity()}, engine)
    late = make_sheet(effects={"gravity": tc.effects.Gravity()})
    late.engine = engine
    late = late.double()
    late.boundaries["hand"] = tc.boundaries.Grasp.corner("upper-left")
    late.effects["bending"] = tc.effects.Bending(1e-5)
    cloth.effects["bending"] = tc.effects.Bending(1e-5)
    first, second = (
        parameter(parameter.rest_state(), motion, times=(0.0, 0.04)).x for parameter in (cloth, copy.deepcopy(late))
    )
    assert torch.equal(first, second)
    with pytest.raises(InvalidInput, match="effects: table; got Plane"):
        late.effects["table"] = tc.boundaries.Plane()
    with pytest.raises(InvalidInput, match="another cloth"):
        make_sheet(5).boundaries["hand"] = late.boundaries["hand"]


# -- gradients -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("engine", ENGINES)
def test_gradients_that_are_computed_again_are_of_the_parameters_of_the_call(engine):
    """Those of ``functional_call`` are gone when the backward pass comes."""
    torch.manual_seed(0)
    cloth, motion = gripped({"learned": Learned()}, engine)
    weights = {k: (1.5 * p.detach()).requires_grad_() for k, p in cloth.named_parameters() if "network" in k}
    result = []
    for checkpoint in (True, False):
        options = {"times": (0.0, 0.04), "checkpoint": checkpoint}
        x = functional_call(cloth, weights, (cloth.rest_state(), motion), options).x[-1]
        result.append(torch.autograd.grad(x.square().sum(), list(weights.values())))
    torch.testing.assert_close(result[0], result[1], rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("engine", ENGINES)
def test_what_is_drawn_is_drawn_again(engine):
    cloth, motion = gripped({"learned": Learned(nn.Dropout(0.3))}, engine)
    result, weights = [], list(cloth.effects["learned"].parameters())
    for checkpoint in (True, False):
        torch.manual_seed(3)
        result.append(torch.autograd.grad(loss_of(cloth, motion, checkpoint=checkpoint), weights))
    torch.testing.assert_close(result[0], result[1], rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("engine", ENGINES)
def test_gradients_by_torch_func_are_those_of_backward(engine):
    cloth, motion = gripped({"gravity": tc.effects.Gravity()}, engine)
    x = cloth.rest_state().x
    loss = lambda x: cloth(cloth.state(x), motion, times=(0.0, 0.02)).x[-1].square().sum()  # noqa: E731
    parameter = x.clone().requires_grad_()
    (wanted,) = torch.autograd.grad(loss(parameter), parameter)
    torch.testing.assert_close(torch.func.grad(loss)(x), wanted, rtol=1e-9, atol=1e-15)


# -- modes -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("engine", ENGINES)
def test_slopes_are_the_same_in_inference_mode(engine):
    cloth, motion = gripped({"gravity": tc.effects.Gravity()}, engine)
    lifted = torch.zeros_like(motion["hand"].pose[None])
    lifted[..., 2, 3] = motion["hand"].t
    along = tc.Directions({"material.youngs_modulus.raw": torch.ones(1)}, motion={"hand": lifted})
    ask = lambda: cloth.sensitivities(cloth.rest_state(), motion, (0.0, 0.04), along=along)[1].x  # noqa: E731
    wanted = ask()
    with torch.inference_mode():
        result = ask()
    assert float(wanted.abs().max()) > 0
    assert torch.equal(result, wanted)


def test_autocast_takes_no_digits():
    cloth, motion = gripped({"gravity": tc.effects.Gravity()}, "reference")
    cloth, motion = cloth.float(), {"hand": motion["hand"]._replace(pose=motion["hand"].pose.float())}
    arm = tc.robots.load("rizon4", frame="tcp_closed", dtype=torch.float32)
    q = torch.stack([arm.home, arm.home + 0.05])
    ask = lambda: (cloth(cloth.rest_state(), motion, times=(0.0, 0.04)).x, arm(q), arm.jacobian(q))  # noqa: E731
    wanted = ask()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        result = ask()
    for a, b in zip(result, wanted, strict=True):
        assert a.dtype == b.dtype
        assert torch.equal(a, b)


def test_a_material_of_another_precision_is_cast_by_the_engine():
    cloth, motion = gripped(engine="fused")
    wanted = loss_of(cloth, motion)
    cloth.material.float()
    result = loss_of(cloth, motion)
    assert result.dtype == torch.float64
    torch.testing.assert_close(result, wanted, rtol=1e-5, atol=0)
    result.backward()
    assert cloth.material.youngs_modulus.raw.grad.dtype == torch.float32


@pytest.mark.parametrize("engine", ENGINES)
def test_what_is_made_on_the_way_is_made_where_the_cloth_is(engine):
    """Not on a default device: tensors there would be handed to the library as memory that is none."""
    cloth, motion = gripped({"gravity": tc.effects.Gravity()}, engine)
    arm = tc.robots.load("rizon4")
    faces, q, t = torch.as_tensor(cloth.mesh.faces), torch.stack([arm.home, arm.home + 0.05]), torch.tensor([0.0, 1.0])
    along = tc.Directions({"areal_density.raw": torch.ones(1)})

    def ask():
        state = cloth.settle(cloth.rest_state(), motion, duration=0.02)
        x = cloth(state, motion, times=(0.0, 0.04)).x
        moved = cloth.sensitivities(state, motion, (0.0, 0.04), along=along)[1].x
        (slope,) = torch.autograd.grad(x.square().sum(), cloth.areal_density.raw)
        near = tc.losses.chamfer_to_surface(x[-1].detach(), x[0].detach(), faces)
        return x.detach(), moved, slope, near, arm.motion(q, t).pose, arm.inverse(arm(q)), cloth.stable_step()

    wanted = ask()
    with torch.device("meta"):
        result = ask()
    torch.testing.assert_close(result, wanted, rtol=0, atol=0)
