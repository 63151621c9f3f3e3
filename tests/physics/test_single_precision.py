"""In float32 a substep of slow motion is a few units in the last place: what is rounded away must not add up."""

import math

import pytest
import torch

import torchcloth as tc
from torchcloth.dynamics.contact.transfer import place_on_grid, transfer_director_forces
from torchcloth.effects import AbstractEffect

SPEED = 1e-3  # m/s: some two units a substep at half a metre from the origin


class Nothing(AbstractEffect):
    """A user's effect, so that torch has a part in every substep."""

    acts_on = "vertices"

    def coefficients(self):
        return None

    def force(self, c, inputs):
        return torch.zeros_like(inputs.x)


@pytest.fixture(autouse=True)
def single():
    torch.set_default_dtype(torch.float32)
    yield
    torch.set_default_dtype(torch.float64)


def strip(engine: str, effects=None, **boundaries) -> tc.Cloth:
    mesh = tc.meshes.rectangle(0.06, 0.02, resolution=(4, 2))
    material = tc.materials.AEP(youngs_modulus=3e5)
    return tc.Cloth(mesh, material, 0.2, effects or {}, boundaries, contact=None, engine=engine)


def way(seconds: float, poses) -> tc.Trajectory:
    t = torch.linspace(0, seconds, 11)
    return tc.Trajectory(t, torch.stack([poses(float(s)) for s in t]), torch.ones(11, dtype=torch.bool))


def shifted(x: float) -> torch.Tensor:
    pose = torch.eye(4)
    pose[0, 3] = x
    return pose


@pytest.mark.parametrize(
    ("engine", "effects"), [("fused", None), ("fused", {"own": Nothing()}), ("reference", None)], ids=str
)
def test_slow_grippers_take_the_cloth_along(engine, effects):
    seconds = 0.06
    cloth = strip(engine, effects, hand=tc.boundaries.Grasp(vertices=[0, 4]))
    x = cloth.rest_state().x + torch.tensor([0.61, 0.3, 0.0])
    out = cloth(cloth.state(x), {"hand": way(seconds, lambda s: shifted(SPEED * s))}, times=[0.0, 0.03, seconds])
    moved = (out.x[-1].detach().double() - out.x[0].detach().double())[[0, 4]]
    assert cloth.engine_in_use.startswith(engine)
    torch.testing.assert_close(moved[:, 0], torch.full((2,), SPEED * seconds).double(), rtol=2e-3, atol=0)
    assert float(moved[:, 1:].abs().max()) < 1e-9


@pytest.mark.parametrize("engine", ["fused", "reference"])
def test_a_slow_belt_takes_the_cloth_along(engine):
    seconds = 0.06
    effects = {"gravity": tc.effects.Gravity()}
    cloth = strip(engine, effects, belt=tc.boundaries.Plane(friction=2.0, moving=True))
    state = cloth.state(cloth.rest_state().x + torch.tensor([0.61, 0.3, 0.0]))
    state = state._replace(v=torch.tensor([SPEED, 0.0, 0.0]).expand_as(state.x).clone())
    out = cloth(state, {"belt": way(seconds, lambda s: shifted(SPEED * s))}, times=[0.0, 0.03, seconds])
    moved = (out.x[-1].detach().double() - out.x[0].detach().double())[:, 0]
    torch.testing.assert_close(moved, torch.full_like(moved, SPEED * seconds), rtol=5e-3, atol=0)


@pytest.mark.parametrize("engine", ["fused", "reference"])
def test_turning_grippers_keep_their_distance(engine):
    """About an axis 0.6 m away, so slowly that the matrix of a substep has ones on its diagonal."""
    seconds, rate = 0.1, 0.5
    cloth = strip(engine, hand=tc.boundaries.Grasp(vertices=list(range(8))))

    def turned(s: float) -> torch.Tensor:
        pose, angle = torch.eye(4), rate * s
        pose[0, 0] = pose[1, 1] = math.cos(angle)
        pose[1, 0], pose[0, 1] = math.sin(angle), -math.sin(angle)
        return pose

    x = cloth.rest_state().x + torch.tensor([0.6, 0.0, 0.0])
    with torch.no_grad():
        end = cloth(cloth.state(x), {"hand": way(seconds, turned)}, times=[0.0, seconds]).x[-1].double()
    expected = x.double() @ turned(seconds)[:3, :3].double().mT
    assert float((end - expected).abs().max()) < 5e-7


@pytest.mark.parametrize(("engine", "seconds"), [("fused", 0.5), ("reference", 0.03)])
def test_stiff_cloth_does_not_creep_on_a_table_far_from_the_origin(engine, seconds):
    """Strains by rounded positions, 1e-6 at 1 m, pulled as hard as friction holds: it slid by millimetres a second."""
    angle = math.atan(0.3 * 0.9)  # nine tenths of what friction holds
    mesh = tc.meshes.rectangle(0.3, 0.3, resolution=(10, 10))
    effects = {
        "gravity": tc.effects.Gravity((9.81 * math.sin(angle), 0.0, -9.81 * math.cos(angle))),
        "bending": tc.effects.Bending(1e-5),
    }
    material = tc.materials.AEP.preset("coated_nylon")
    table = {"table": tc.boundaries.Plane(friction=0.3)}
    cloth = tc.Cloth(mesh, material, 0.15, effects, table, contact=None, engine=engine)
    x = cloth.rest_state().x + torch.tensor([1.0, 0.0, 0.0])
    with torch.no_grad():
        out = cloth(cloth.state(x), times=[0.0, 0.5 * seconds, seconds])
    assert float((out.x[-1].double() - x.double()).mean(0)[0].abs()) < 2e-6
    assert float(out.v[-1].norm(dim=-1).max()) < 1e-4


def test_stiff_cloth_that_hangs_far_from_the_origin_comes_to_rest():
    """It was heated by what was rounded, at 0.15 m/s, and ever more."""
    mesh = tc.meshes.rectangle(0.2, 0.2, resolution=(8, 8))
    effects = {"gravity": tc.effects.Gravity(), "air": tc.effects.AirDrag(1.2), "damping": tc.effects.MassDamping(8.0)}
    hand = {"hand": tc.boundaries.Grasp.corner("upper-left")}
    cloth = tc.Cloth(mesh, tc.materials.AEP(2e7), 0.15, effects, hand, contact=None)
    x = cloth.rest_state().x @ torch.tensor([[1.0, 0, 0], [0, 0, 1.0], [0, 1.0, 0]]) + torch.tensor([1.0, 0, 1.0])
    t = torch.tensor([0.0, 0.5, 1.0, 1.5])
    still = tc.Trajectory(t, torch.eye(4).repeat(4, 1, 1), torch.ones(4, dtype=torch.bool))
    with torch.no_grad():
        out = cloth(cloth.state(x), {"hand": still}, times=t)
    assert float(out.v[-1].square().mean().sqrt()) < 0.01


@pytest.mark.parametrize(("engine", "seconds"), [("fused", 0.5), ("reference", 0.02)])
def test_inner_friction_does_not_wear_off_as_cloth_is_turned(engine, seconds):
    """Rounding of positions is a path to it at every substep: of its share a fifth was left after a second."""
    mesh = tc.meshes.rectangle(0.1, 0.1, resolution=(11, 11))
    effects = {"own": tc.effects.BendingFriction(2e-4)}
    gripped = {"hand": tc.boundaries.Grasp(range(len(mesh.vertices)))}
    cloth = tc.Cloth(mesh, tc.materials.AEP(3e5), 0.2, effects, gripped, contact=None, engine=engine)
    x = cloth.rest_state().x
    x[:, 2] = 0.01 * torch.sin(30 * x[:, 0])
    state = cloth.state(x + torch.tensor([0.6, 0.3, 0.2]))
    memory = state.memory["effects.own"].clone()
    half = memory.shape[-1] // 2
    memory[..., half:] = 0.5
    t = torch.linspace(0, seconds, 11, dtype=torch.float64)
    pose, angle = torch.eye(4, dtype=torch.float64).repeat(11, 1, 1), 0.1 * t
    pose[:, 0, 0], pose[:, 1, 1], pose[:, 0, 1], pose[:, 1, 0] = angle.cos(), angle.cos(), -angle.sin(), angle.sin()
    turning = tc.Trajectory(t, pose.float(), torch.ones(11, dtype=torch.bool))
    with torch.no_grad():
        end = cloth(state._replace(memory={"effects.own": memory}), {"hand": turning}, times=[0.0, seconds]).state
    assert float(end.memory["effects.own"][..., half:].abs().mean()) == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize("corner", [1.5 - 1e-7, 0.5 + 1e-7])
def test_a_node_that_hardly_weighs_has_finite_derivatives(corner):
    """One over the square of its mass is more than float32 holds: gradients of contact were NaN."""
    grid = tc.Contact(spacing=0.01).build_grid(tc.meshes.rectangle(0.1, 0.1, resolution=(5, 5)))
    place = (0.01 * torch.full((1, 3), corner)).requires_grad_()
    mass = torch.tensor([[1e-6]], requires_grad=True)
    scene, node_scratch = torch.zeros(1, dtype=torch.int64), torch.zeros(grid.nodes**3, dtype=torch.int32)
    nodes = place_on_grid(place, mass, scene, grid, node_scratch, torch.zeros(3))
    change, moment = transfer_director_forces(nodes, torch.ones(1, 3), torch.ones(1, 3), grid.spacing, 1e-4)
    (change.sum() + moment.sum()).backward()
    assert torch.isfinite(place.grad).all()
    assert torch.isfinite(mass.grad).all()
