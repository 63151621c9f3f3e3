"""Distances between solids: closed forms, an optimiser, and which links of a Rizon can meet at all."""

import math
from itertools import combinations

import pytest
import torch
from scipy.optimize import minimize

from torchcloth import robots
from torchcloth.robots.arm import Primitive
from torchcloth.robots.clearance import (
    DISTANCE_TOLERANCE_M,
    MAX_RESOLVED_GAP_M,
    NamedSolid,
    Solids,
    bound_distances,
    smallest_gap,
)

# flexiv_ros2's MoveIt set-up: pairs that are never checked because no posture brings them together
NEVER = {(0, 2), (0, 3), (0, 4), (1, 3), (1, 4), (2, 4), (2, 5), (3, 5), (3, 6), (3, 7), (4, 6), (4, 7)}


def pose(x=0.0, y=0.0, z=0.0, about_x=0.0, about_z=0.0):
    (cx, sx), (cz, sz) = ((math.cos(a), math.sin(a)) for a in (about_x, about_z))
    out = torch.eye(4, dtype=torch.float64)
    first = torch.tensor([[1.0, 0, 0], [0, cx, -sx], [0, sx, cx]], dtype=torch.float64)
    out[:3, :3] = torch.tensor([[cz, -sz, 0.0], [sz, cz, 0], [0, 0, 1]], dtype=torch.float64) @ first
    out[:3, 3] = torch.tensor([x, y, z], dtype=torch.float64)
    return out


def distance(a: Primitive, b: Primitive) -> float:
    one, other = (Solids.from_primitives([p], 1).select(torch.tensor([0]), torch.tensor([0])) for p in (a, b))
    return float(bound_distances(one, other))


def box(*size, **place):
    return Primitive("box", size, pose(**place), "box")


def cylinder(radius, length, **place):
    return Primitive("cylinder", (radius, length), pose(**place), "cylinder")


def sphere(radius, **place):
    return Primitive("sphere", (radius,), pose(**place), "sphere")


@pytest.mark.parametrize(
    ("a", "b", "truth"),
    [
        (sphere(0.1), sphere(0.2, x=0.5), 0.2),
        (box(0.2, 0.2, 0.2), sphere(0.1, x=0.3, y=0.3, z=0.3), 0.2 * math.sqrt(3) - 0.1),
        (box(2, 2, 0.1), cylinder(0.05, 0.4, z=0.3, about_x=math.pi / 2), 0.2),
        (cylinder(0.05, 1.0), cylinder(0.04, 1.0, x=0.1, about_x=math.pi / 2), 0.01),
        (cylinder(0.1, 0.4), box(0.1, 0.1, 0.1, x=0.2, z=0.35), math.hypot(0.05, 0.1)),
        (cylinder(0.1, 0.4), sphere(0.05, x=0.3, z=0.3), math.hypot(0.2, 0.1) - 0.05),
        (box(0.2, 0.2, 0.2), box(0.1, 0.1, 0.1, x=0.1 + 0.02 + 0.05 * math.sqrt(2), about_z=math.pi / 4), 0.02),
    ],
)
def test_closed_forms(a, b, truth):
    for first, second in ((a, b), (b, a)):
        result = distance(first, second)
        assert result <= truth + 1e-9, "a lower bound"
        assert result == pytest.approx(truth, abs=DISTANCE_TOLERANCE_M)


@pytest.mark.parametrize("overlapping", [sphere(0.2, x=0.15), box(0.3, 0.1, 0.1), cylinder(0.3, 0.1, about_x=1.0)])
def test_overlap_is_no_distance(overlapping):
    assert distance(box(0.2, 0.2, 0.2), overlapping) <= 0


def test_against_an_optimiser():
    """Random boxes and cylinders: scipy minimises the distance of a point in each."""
    generator = torch.Generator().manual_seed(3)

    def draw(low, high):
        return float(low + (high - low) * torch.rand((), generator=generator))

    for _ in range(12):
        a = box(draw(0.1, 0.3), draw(0.1, 0.3), draw(0.1, 0.3), about_x=draw(-3, 3), about_z=draw(-3, 3))
        b = cylinder(draw(0.05, 0.1), draw(0.1, 0.4), x=draw(0.3, 0.5), z=draw(-0.3, 0.3), about_x=draw(-3, 3))
        result, truth = distance(a, b), optimised(a, b)
        assert result == pytest.approx(max(truth, 0), abs=3e-4)


def optimised(a, b):
    def ends(u):
        p = (a.pose[:3, :3].numpy() @ (u[:3] * [s / 2 for s in a.size])) + a.pose[:3, 3].numpy()
        q = (b.pose[:3, :3].numpy() @ u[3:6]) + b.pose[:3, 3].numpy()
        return p - q

    radius, length = b.size
    bounds = [(-1, 1)] * 3 + [(-radius, radius)] * 2 + [(-length / 2, length / 2)]
    inside = {"type": "ineq", "fun": lambda u: radius**2 - u[3] ** 2 - u[4] ** 2}
    result = minimize(lambda u: (ends(u) ** 2).sum(), [0.0] * 6, bounds=bounds, constraints=inside, tol=1e-12)
    return math.sqrt(result.fun)


def test_nearest_finds_pair_and_time():
    path = torch.eye(4, dtype=torch.float64).repeat(5, 1, 1)
    path[:, 0, 3] = torch.tensor([1.0, 0.5, 0.26, 0.5, 1.0])
    solids = [
        NamedSolid("post", sphere(0.1)),
        NamedSolid("hand", Primitive("sphere", (0.1,), path, "hand")),
        NamedSolid("far", sphere(0.1, x=9)),
    ]
    gap = smallest_gap(solids, [(0, 1), (0, 2)], torch.arange(5) * 0.1)
    assert (gap.first, gap.second, gap.time) == ("post", "hand", pytest.approx(0.2))
    assert gap.distance == pytest.approx(0.06, abs=DISTANCE_TOLERANCE_M)
    assert smallest_gap(solids, [(0, 2)], torch.arange(5)).distance == MAX_RESOLVED_GAP_M
    assert smallest_gap(solids, [], torch.arange(5)).distance == MAX_RESOLVED_GAP_M
    apart = [NamedSolid(str(x), sphere(0.1, x=x)) for x in (0.0, 0.5)]
    assert smallest_gap(apart, [(0, 1)], torch.arange(1)).distance == MAX_RESOLVED_GAP_M
    assert smallest_gap(apart, [(0, 1)], torch.arange(1), min_distance=0.4).distance == pytest.approx(
        0.3, abs=DISTANCE_TOLERANCE_M
    )


def test_links_that_the_makers_never_check_cannot_meet(random_q):
    """The primitives agree with Flexiv's own meshes about which links can collide."""
    arm = robots.load("rizon4")
    q = random_q(arm, 150)
    solids = [NamedSolid(p.link, p) for p in arm.geometry(q)]
    never = [
        (i, j) for i, j in combinations(range(len(solids)), 2) if (arm.solid_joints[i], arm.solid_joints[j]) in NEVER
    ]
    assert {(arm.solid_joints[i], arm.solid_joints[j]) for i, j in never} == NEVER
    for i, j in never:
        assert smallest_gap(solids, [(i, j)], torch.arange(150)).distance > 0.005, (solids[i].name, solids[j].name)
    met = [(i, j) for i, j in combinations(range(len(solids)), 2) if arm.solid_joints[j] - arm.solid_joints[i] > 4]
    assert smallest_gap(solids, met, torch.arange(150)).distance <= 0, "others can"
