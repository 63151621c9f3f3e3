"""Boundaries in the fused engine: solids, laws of friction, contact points, grips."""

import pytest
import torch
from helpers.engine_agreement import check_agreement, draw_noise
from torch import Tensor

import torchcloth as tc
from torchcloth.boundaries import (
    Box,
    Capsule,
    Coulomb,
    Cylinder,
    Elliptic,
    Grasp,
    MeshSolid,
    Plane,
    Sphere,
    Stribeck,
)
from torchcloth.boundaries.motion import sample_trajectory
from torchcloth.dynamics import substep
from torchcloth.effects import AddedMass, Gravity, GripSlip, LineMass
from torchcloth.engine import fused
from torchcloth.engine.builder import UnsupportedPart


def turned(z: float, angle: float = 0.3) -> Tensor:
    """A pose, turned about z."""
    pose = torch.eye(4)
    pose[:2, :2] = rotation(torch.tensor(angle))
    pose[2, 3] = z
    return pose


def rotation(angle: Tensor) -> Tensor:
    return torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()], -1).unflatten(-1, (2, 2))


def brick(size=(0.08, 0.09, 0.1), **options) -> MeshSolid:
    """A box as a mesh, whose top is at z = 0; the grid ends before the sheet does."""
    corners = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5])] * 3).numpy() * size - [0, 0, size[2] / 2]
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    faces += [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    return MeshSolid(corners, faces, cell=0.011, **options)


SOLIDS = {  # whose tops are at z = 0
    "plane": lambda **o: Plane(normal=(0.03, -0.1, 1.0), **o),
    "plane in a pose": lambda **o: Plane((0.0, 0.0, 0.1), pose=turned(-0.1), **o),
    "box": lambda **o: Box((0.08, 0.09, 0.2), turned(-0.1), **o),
    "sphere": lambda **o: Sphere(0.2, (0.0, 0.01, -0.2), **o),
    "capsule": lambda **o: Capsule((0.02, -0.03, -0.05), (-0.02, 0.03, -0.05), 0.05, **o),
    "cylinder": lambda **o: Cylinder((0.0, 0.0, -0.05), (0.0, 0.01, 0.0), 0.04, **o),
    "mesh": brick,
}
SMALL = {  # smaller than the triangles
    "plane": SOLIDS["plane"],
    "box": lambda **o: Box((0.05, 0.03, 0.2), turned(-0.1), **o),
    "sphere": lambda **o: Sphere(0.02, (0.0, 0.01, -0.02), **o),
    "mesh": lambda **o: brick((0.05, 0.03, 0.1), **o),
}
LAWS = {
    "coulomb": lambda: Coulomb(0.4),
    "stribeck": lambda: Stribeck(0.3, 0.6, 0.1),
    "elliptic": lambda: Elliptic(0.4, 0.2, (1.0, 0.3, 0.0)),
}


def sheet(boundaries, effects=None) -> tc.Cloth:
    mesh = tc.meshes.rectangle(0.1, 0.1, resolution=(6, 6))
    return tc.Cloth(mesh, tc.materials.AEP(1e3, 0.05), 0.15, {"g": Gravity(), **(effects or {})}, boundaries, None)


def falling(cloth: tc.Cloth, depth: float = 0.0, scenes: tuple[int, ...] = (), speed: float = 0.5):
    """Uneven, about z = 0; half of the vertices fall straight, the others slide."""
    x = cloth.rest_state().x - torch.tensor([0.05, 0.05, depth])
    x = x + 1e-3 * draw_noise((*scenes, *x.shape), 1)
    v = draw_noise(x.shape, 2)
    v[..., ::2, :2] *= 0.05
    v[..., 2] = -v[..., 2].abs()
    return cloth.state(x, speed * v)


def path(scenes: tuple[int, ...] = (), closed=(True, True, True)) -> tc.Trajectory:
    """10 ms; turns and wanders."""
    pose = torch.eye(4).repeat(*scenes, 3, 1, 1)
    pose[..., :2, :2] = rotation(torch.linspace(0, 0.05, 3))
    pose[..., :3, 3] = 2e-3 * draw_noise((*scenes, 3, 3), 5)
    return tc.Trajectory(torch.linspace(0, 0.01, 3, dtype=torch.float64), pose, torch.tensor(closed))


def moves(cloth: tc.Cloth, scenes: tuple[int, ...] = ()) -> dict[str, tc.Trajectory]:
    return {name: path(scenes) for name, boundary in cloth.boundaries.items() if boundary.is_prescribed}


def watched(monkeypatch) -> dict[str, bool]:
    """Whether anything was seen to stick and to slip."""
    seen, taken = {"sticks": False, "slips": False}, Coulomb.slip_reduction

    def watch(friction, slip, push):
        share = taken(friction, slip, push)
        if not share.is_meta:
            seen["sticks"] |= bool((share[push > 0] == 1).any())
            seen["slips"] |= bool((share[push > 0] < 1).any())
        return share

    monkeypatch.setattr(Coulomb, "slip_reduction", watch)
    return seen


EACH = [  # shape and law are parts of their own: every one of both, and all laws on a plane and on what has patches
    *((solid, "coulomb", moving) for solid in SOLIDS for moving in (False, True)),
    *((solid, law, law == "elliptic") for solid in ("plane in a pose", "mesh") for law in LAWS if law != "coulomb"),
]


@pytest.mark.parametrize(("solid", "law", "moving"), EACH)
def test_solids(solid, law, moving, monkeypatch):
    body = SOLIDS[solid](friction=LAWS[law](), moving=moving, offset=1e-4)
    cloth = sheet({"body": body})
    seen = watched(monkeypatch)
    check_agreement(cloth, moves(cloth), falling(cloth))
    assert all(seen.values()), seen


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("solid", SMALL)
def test_contact_points(solid, moving):
    made = SMALL[solid](sampling=0.01, moving=moving)
    cloth, bare = sheet({"body": made}), sheet({"body": SMALL[solid](moving=moving)})
    state = falling(cloth, 5e-4)
    check_agreement(cloth, moves(cloth), state)
    assert float((run(cloth, state).v - run(bare, state).v).norm()) > 1e-3  # the points matter


def test_contact_points_of_uneven_mass():
    cloth = sheet({"body": SMALL["box"](sampling=0.01)}, {"hem": LineMass(5e-3)})
    check_agreement(cloth, moves(cloth), falling(cloth, 5e-4))


def run(cloth, state, substeps=20):
    times = torch.linspace(0, 1e-4 * substeps, substeps + 1, dtype=torch.float64)
    prescribed = {name: sample_trajectory(trajectory, times) for name, trajectory in moves(cloth).items()}
    with torch.no_grad():
        return fused.rollout(cloth.build_model(), state, 1e-4, prescribed, substeps)[0]


def test_no_fast_point_is_missed():
    """Up to 2 mm per substep."""
    cloth = sheet({"body": SMALL["box"](sampling=0.01)})
    check_agreement(cloth, {}, falling(cloth, -5e-3, speed=10.0), substeps=20)


def test_points_as_far_apart_as_vertices():
    cloth = sheet({"body": Plane(sampling=1.0)})
    check_agreement(cloth, {}, falling(cloth))


@pytest.mark.parametrize("sampling", [None, 0.012])
def test_batch(sampling):
    """Coefficients, sizes and poses of their own in every scene."""
    friction = Stribeck(0.2, 0.5)
    box = Box((0.08, 0.09, 0.2), turned(-0.1), friction, moving=True, sampling=sampling)
    friction.raw = torch.nn.Parameter(torch.tensor([[0.2], [0.5], [0.8]]))
    box.size.raw = torch.nn.Parameter(box.size.raw + 0.05 * draw_noise((3, 3), 7))
    cloth = sheet({"box": box, "ball": Sphere(0.2, (0.0, 0.0, -0.2), Coulomb(torch.tensor([[0.1], [0.2], [0.3]])))})
    check_agreement(cloth, moves(cloth, (3,)), falling(cloth, 4e-3, (3,)))


def test_a_batch_of_ellipses():
    along, across = torch.tensor([[0.1], [0.4]]), torch.tensor([[0.5], [0.2]])
    together, alone = (sheet({"table": Plane(friction=Elliptic(*mu))}) for mu in ((along, across), (0.4, 0.2)))
    state = falling(together, 4e-3, (2,))
    check_agreement(together, {}, state)
    times = (0.0, 4e-3)
    first, second = (alone(alone.state(x, v), times=times).x[-1] for x, v in zip(state.x, state.v, strict=True))
    both = together(state, times=times).x[:, -1]
    torch.testing.assert_close(both[1], second)
    assert not torch.allclose(both[0], first)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("sampling", [None, pytest.param(0.01, marks=pytest.mark.slow)])
def test_what_bodies_give_with_the_air(law, sampling):
    slope = 0.0 if law == "elliptic" else 0.03  # its axis lies in the plane
    for body in (
        Box((0.08, 0.09, 0.2), turned(-0.1), LAWS[law](), moving=True, sampling=sampling),
        Plane(normal=(slope, 0.0, 1.0), friction=LAWS[law](), sampling=sampling),
    ):
        cloth = sheet({"box": body}, {"air": AddedMass(0.1)})
        check_agreement(cloth, moves(cloth), falling(cloth, 1e-3))


@pytest.mark.parametrize(
    ("hold", "mobility", "closed"),
    [
        (100.0, 0.01, (True, True, True)),
        (0.5, 1.0, (True, True, True)),
        (0.01, 0.1, (True, False, False)),
        (0.01, 0.1, (False, True, False)),
    ],
    ids=["holds", "slips", "opens", "closes"],
)
@pytest.mark.parametrize("air", [{}, {"air": AddedMass(0.1)}], ids=["vacuum", "air"])
def test_grips(hold, mobility, closed, air):
    cloth = sheet({"hand": Grasp([0, 1, 6, 7]), "floor": Plane()}, {"slip": GripSlip("hand", mobility, hold), **air})
    state = falling(cloth)
    check_agreement(cloth, {"hand": path(closed=closed)}, state)
    perfect = sheet({"hand": Grasp([0, 1, 6, 7]), "floor": Plane()}, air)
    assert torch.equal(run(cloth, state).x, run(perfect, state).x) == (hold == 100.0)


@pytest.mark.slow
def test_one_after_another():
    """What a boundary gives is what it changed, whatever came before and however often the loop ends."""
    effects = {"slip": GripSlip("hand", 0.1, 0.1), "more": GripSlip("hand", 0.2, 0.05), "air": AddedMass(0.05)}
    boundaries = {
        "box": Box((0.05, 0.03, 0.2), turned(-0.1), moving=True, sampling=0.01),
        "hand": Grasp([0, 1, 6, 7]),
        "floor": Plane((0.0, 0.0, -1e-3)),
        "ball": Sphere(0.02, (0.02, 0.02, -0.02), sampling=0.012, friction=LAWS["stribeck"]()),
        "other": Grasp([34, 35]),
    }
    cloth = sheet(boundaries, effects)
    check_agreement(cloth, moves(cloth), falling(cloth, 5e-4))


def test_contact_does_not_hang_on_rounding():
    """Of the reference too: what counts as a touching point must not be decided by the last bit."""
    cloth = sheet({"body": Box((0.05, 0.03, 0.2), turned(-0.1), sampling=0.012)})
    state = falling(cloth, 2e-3, (3,))
    near = state._replace(x=state.x * (1 + 1e-14))
    with torch.no_grad():
        ends = [substep.rollout(cloth.build_model(), s, 1e-4, {}, 100)[0].v for s in (state, near)]
    assert float((ends[0] - ends[1]).norm() / ends[0].norm()) < 1e-11


class Soft(Plane):
    """A law of one's own."""


class Greasy(Coulomb):
    """A law of one's own."""


@pytest.mark.parametrize(("boundary", "named"), [(Soft(), "Soft"), (Plane(friction=Greasy(0.1)), "Greasy")])
def test_what_users_write_is_named(boundary, named):
    cloth = sheet({"mine": boundary})
    with pytest.raises(UnsupportedPart, match=f"'mine'.*{named}"):
        fused.rollout(cloth.build_model(), cloth.rest_state(), 1e-4, {}, 1)


def test_float32():
    """Gradients of a sheet that touches a sampled box, over 200 substeps."""
    results = []
    for dtype in (torch.float32, torch.float64):
        torch.set_default_dtype(dtype)
        cloth = sheet({"box": SMALL["box"](sampling=0.01)})
        state = falling(cloth.double(), 5e-4).map(lambda t, dtype=dtype: t.to(dtype).requires_grad_())
        end = fused.rollout(cloth.to(dtype).build_model(), state, 1e-4, {}, 200)[0]
        (100 * end.x.square().sum() + end.v.square().sum()).backward()
        results.append(torch.cat([state.x.grad.flatten() * 1e-4, state.v.grad.flatten()]).double())
    assert float((results[0] - results[1]).norm() / results[1].norm()) < 1e-3
