"""A table that pulls, in closed form: what lifts a sheet off it, what slides it, and what that costs."""

import pytest
import torch

import torchcloth as tc
from torchcloth.effects import Adhesion, BodyForce, Gravity
from torchcloth.errors import InvalidInput
from torchcloth.types import EffectInputs

DENSITY, STRESS, GAP, MU, G = 0.2, 1.5, 1e-3, 0.4, 9.81  # kg/m^2, Pa, m, -, m/s^2


@pytest.fixture(autouse=True)
def _values_only():
    with torch.no_grad():
        yield


def lying(acceleration, normal=(0.0, 0.0, 1.0)):
    """A sheet on a plane through the origin, pushed by an acceleration [3] m/s^2 in the plane's own axes."""
    n = torch.tensor(normal) / torch.tensor(normal).norm()
    turn = torch.linalg.qr(torch.stack([n, *torch.eye(3)[:2]], 1)).Q[:, [1, 2, 0]]
    turn = turn * torch.sign(turn[:, 2] @ n)
    if torch.linalg.det(turn) < 0:
        turn[:, 0] = -turn[:, 0]
    mesh = tc.meshes.rectangle(0.2, 0.15, resolution=(5, 4))
    effects = {
        "gravity": Gravity(tuple((-G * n).tolist())),
        "pull": Adhesion(STRESS, GAP, normal=normal),
        "push": BodyForce((turn @ torch.tensor(acceleration))[None]),
    }
    table = {"table": tc.boundaries.Plane(normal=normal, friction=MU)}
    cloth = tc.Cloth(mesh, tc.materials.AEP(1e5, 0.3), DENSITY, effects, table, contact=None)
    start = cloth.state(cloth.rest_state().x @ turn.mT)
    moved = cloth(start, times=[0.0, 0.05]).x[-1] - start.x
    return (moved @ turn).amax(-2)


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.3, -0.5, 0.8)])
def test_it_leaves_when_lifted_by_more_than_its_weight_and_the_pull(normal):
    least = G + STRESS / DENSITY
    assert float(lying((0.0, 0.0, 0.99 * least), normal)[2]) == pytest.approx(0.0, abs=1e-9)
    assert float(lying((0.0, 0.0, 1.5 * least), normal)[2]) > GAP


def test_it_slides_when_pushed_by_more_than_friction_of_weight_and_pull():
    least = MU * (G + STRESS / DENSITY)
    assert float(lying((0.99 * least, 0.0, 0.0))[0]) == pytest.approx(0.0, abs=1e-9)
    assert float(lying((1.1 * least, 0.0, 0.0))[0]) > 1e-4


def test_lifting_costs_what_it_says():
    mesh = tc.meshes.rectangle(0.2, 0.15, resolution=(5, 4))
    effect = Adhesion(STRESS, GAP).bind(mesh)
    heights = torch.linspace(0.0, 2 * GAP, 2001)
    x = torch.as_tensor(mesh.vertices).to(heights) * torch.tensor([1.0, 1.0, 0.0])
    x = x + heights[:, None, None] * torch.tensor([0.0, 0.0, 1.0])
    force = effect.force(effect.coefficients(), EffectInputs(x, torch.zeros_like(x), None, None))  # type: ignore[arg-type]
    work = -float(torch.trapezoid(force[..., 2].sum(-1), heights))
    assert work == pytest.approx(8 / 15 * STRESS * GAP * 0.2 * 0.15, rel=1e-5)
    assert not force[heights >= GAP].any()


def test_a_reach_of_nothing_is_refused():
    with pytest.raises(InvalidInput, match="adhesion gap"):
        Adhesion(gap=0.0)
