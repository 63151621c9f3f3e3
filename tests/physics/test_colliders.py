"""Solid bodies against closed forms, conservation and each other."""

import math
import sys

import numpy as np
import pytest
import torch
from torch.func import functional_call

import torchcloth as tc
from torchcloth.boundaries import (
    Box,
    Capsule,
    Coulomb,
    Cylinder,
    Elliptic,
    MeshSolid,
    Plane,
    Sphere,
    Stribeck,
)
from torchcloth.boundaries.points import TrianglePoints
from torchcloth.errors import InvalidInput, MissingDependency
from torchcloth.testing import check_gradients

G = 9.81


def sheet(boundaries, gravity=(0.0, 0.0, -G), size=0.1, n=4, effects=None, E=1e5, density=0.15, shape=None):
    mesh = tc.meshes.rectangle(*(shape or (size, size)), resolution=n if isinstance(n, tuple) else (n, n))
    forces = {"gravity": tc.effects.Gravity(gravity)} if gravity is not None else {}
    return tc.Cloth(mesh, tc.materials.AEP(E, 0.05), density, forces | (effects or {}), boundaries, contact=None)


def path(t, position, rotation=None):
    """A trajectory from positions [K, 3] and rotations [K, 3, 3]."""
    t = torch.as_tensor(t)
    pose = torch.eye(4).repeat(len(t), 1, 1)
    pose[:, :3, 3] = torch.as_tensor(position)
    if rotation is not None:
        pose[:, :3, :3] = rotation
    return tc.Trajectory(t, pose, torch.ones(len(t), dtype=bool))


def about_z(angle):
    c, s, o = torch.cos(angle), torch.sin(angle), torch.zeros_like(angle)
    return torch.stack([c, -s, o, s, c, o, o, o, o + 1], -1).reshape(-1, 3, 3)


def block(size, centre):
    """A box as a triangle mesh."""
    corners = np.array([[i, j, k] for i in (-0.5, 0.5) for j in (-0.5, 0.5) for k in (-0.5, 0.5)])
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    faces += [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    return corners * np.array(size) + np.array(centre), np.array(faces)


def lowered(z):
    pose = torch.eye(4)
    pose[2, 3] = z
    return pose


GROUND = {  # bodies whose highest place is flat, or nearly, at z = 0
    "plane": lambda **o: Plane(**o),
    "box": lambda **o: Box((1.0, 1.0, 0.2), lowered(-0.1), **o),
    "box sampled": lambda **o: Box((1.0, 1.0, 0.2), lowered(-0.1), sampling=0.01, **o),
    "cylinder's end": lambda **o: Cylinder((0, 0, -0.3), (0, 0, 0), 0.5, **o),
    "cylinder's barrel": lambda **o: Cylinder((0, -1, -1e3), (0, 1, -1e3), 1e3, **o),
    "capsule": lambda **o: Capsule((0, -1, -1e3), (0, 1, -1e3), 1e3, **o),
    "sphere": lambda **o: Sphere(1e3, (0, 0, -1e3), **o),
    "mesh": lambda **o: MeshSolid(*block((0.5, 0.5, 0.2), (0, 0, -0.1)), cell=0.05, **o),
}


def slide(body, angle, direction=(1.0, 0.0), start=0.0, time=0.3):
    """(displacement [V, 3] m, final velocity [V, 3]) of a sheet on a body at z = 0 under tilted gravity."""
    a, b = direction
    cloth = sheet({"body": body}, (G * math.sin(angle) * a, G * math.sin(angle) * b, -G * math.cos(angle)))
    x = cloth.rest_state().x - torch.tensor([0.05, 0.05, 0.0])
    v = torch.zeros_like(x)
    v[:, 0], v[:, 1] = start * a, start * b
    with torch.no_grad():
        out = cloth(cloth.state(x, v), times=[0.0, time])
    return out.x[-1] - x, out.v[-1]


@pytest.mark.parametrize("ground", GROUND)
def test_sticks_and_slides_on_every_solid(ground):
    mu = 0.4
    for slope, slides in ((0.9, False), (1.1, True)):
        angle = math.atan(mu * slope)
        moved, _ = slide(GROUND[ground](friction=mu), angle)
        expected = 0.5 * G * (math.sin(angle) - mu * math.cos(angle)) * 0.3**2 if slides else 0.0
        assert float(moved[:, 0].mean()) == pytest.approx(expected, rel=0.01, abs=1e-5)
        assert float(moved[:, 2].abs().max()) < 1e-5  # a radius of 1 km falls by 4 um over the sheet


@pytest.mark.parametrize("degrees", [0.0, 30.0, 90.0])
def test_friction_of_a_direction(degrees):
    """Elliptical cone, not associated: the force opposes the slip; mu along 0.4, across 0.2."""
    turn = math.radians(degrees)
    mu = 0.4 / math.hypot(math.cos(turn), math.sin(turn) * 2)
    angle = math.atan(0.6)
    moved, _ = slide(Plane(friction=Elliptic(0.4, 0.2)), angle, (math.cos(turn), math.sin(turn)))
    expected = 0.5 * G * (math.sin(angle) - mu * math.cos(angle)) * 0.3**2
    mean = moved.mean(0)
    assert float(mean[0] * math.cos(turn) + mean[1] * math.sin(turn)) == pytest.approx(expected, rel=0.01)
    assert float((mean[1] * math.cos(turn) - mean[0] * math.sin(turn)).abs()) < 1e-9
    moved, _ = slide(Plane(friction=Elliptic(0.4, 0.2)), math.atan(0.95 * mu), (math.cos(turn), math.sin(turn)))
    assert float(moved.abs().max()) < 1e-9


def test_static_friction_is_overcome_once():
    """Between kinetic and static friction a sheet stays where it lies, and slides when it is pushed."""
    law = Stribeck(0.3, 0.45, 0.02)
    angle = math.atan(0.4)
    rests, _ = slide(Plane(friction=law), angle)
    assert float(rests.abs().max()) < 1e-9
    _, v = slide(Plane(friction=law), angle, start=0.3)
    expected = 0.3 + G * (math.sin(angle) - 0.3 * math.cos(angle)) * 0.3
    assert float(v[:, 0].mean()) == pytest.approx(expected, rel=0.005)


@pytest.mark.parametrize(
    "law", [lambda: Elliptic(0.35, 0.35), lambda: Stribeck(0.35, 0.35, 0.1)], ids=["elliptic", "stribeck"]
)
def test_neutral_laws_are_coulombs_bitwise(law):
    angle = math.atan(0.4)
    plain, special = (slide(Sphere(0.3, (0, 0, -0.3), friction=f), angle, (0.6, 0.8)) for f in (0.35, law()))
    assert torch.equal(plain[0], special[0])


def test_a_conveyor_drags_a_sheet_along():
    """At mu g until the belt's speed; the belt feels the drag and the weight."""
    mu, speed = 0.3, 0.5
    cloth = sheet({"belt": Plane(friction=mu, moving=True)})
    motion = {"belt": path([0.0, 1.0], [[0.0, 0.0, 0.0], [speed, 0.0, 0.0]])}
    times = torch.linspace(0, 0.3, 31)
    with torch.no_grad():
        out = cloth(cloth.rest_state(), motion, times)
    got = out.v[..., 0].mean(-1)
    torch.testing.assert_close(got, (mu * G * times).clamp(max=speed), rtol=1e-9, atol=5e-3 * speed)
    assert float(got[-1]) == pytest.approx(speed, rel=1e-9)
    weight = 0.15 * 0.01 * G
    drags, follows = out.wrench["belt"][1:16], out.wrench["belt"][20:]
    torch.testing.assert_close(drags[:, :3].mean(0), torch.tensor([-mu * weight, 0, -weight]), rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(follows[:, :3].mean(0), torch.tensor([0, 0, -weight]), rtol=1e-6, atol=1e-9)


def test_a_sphere_pushed_into_a_hanging_sheet_feels_what_it_gives():
    cloth = sheet(
        {"top": tc.boundaries.Grasp(uv=[[0.0, 0.2], [0.2, 0.2]], radius=0.01), "ball": Sphere(0.04, moving=True)},
        (0.0, -G, 0.0), size=0.2, n=9,
    )  # fmt: skip
    t = torch.linspace(0, 0.2, 9)
    ball = torch.stack([torch.full_like(t, 0.1), torch.full_like(t, 0.1), 0.5 * t - 0.05], -1)
    motion = {"top": path([0.0, 0.2], [[0.0] * 3] * 2), "ball": path(t, ball)}
    times = torch.linspace(0, 0.2, 11)
    with torch.no_grad():
        out = cloth(cloth.rest_state(), motion, times)
        mass = cloth.model().mass
    gained = (mass * out.v).sum(-2)
    forces = out.wrench["top"][1:, :3] + out.wrench["ball"][1:, :3]
    weight = mass.sum() * torch.tensor([0.0, -G, 0.0])
    expected = torch.cumsum(0.02 * (weight - forces), 0)
    torch.testing.assert_close(gained[1:], expected, rtol=0, atol=1e-12)
    assert float(out.wrench["ball"][..., 2].min()) < -0.02  # the ball was pushed back
    depth = cloth.boundaries["ball"].clearance(out.x[-1], motion["ball"].pose[-1])[0].detach()
    assert -1e-5 < float(depth.min()) < 1e-3


def test_a_turning_sphere_carries_a_cap_of_cloth():
    """It comes to turn as the sphere does, and its angular momentum is what the sphere's torque gave."""
    rate, radius = 4.0, 0.1
    cloth = sheet({"ball": Sphere(radius, (0, 0, -radius), friction=0.5, moving=True)}, n=6)
    x = cloth.rest_state().x - torch.tensor([0.05, 0.05, -1e-4])
    t = torch.linspace(0, 0.5, 11)
    motion = {"ball": path(t, torch.zeros(11, 3), about_z(rate * t))}
    times = torch.linspace(0, 0.5, 26)
    with torch.no_grad():
        out = cloth(cloth.state(x), motion, times)
        mass = cloth.model().mass
    spin = (mass * torch.linalg.cross(out.x, out.v)).sum(-2)[:, 2]
    inertia = (mass * (out.x[..., :2] ** 2).sum(-1, keepdim=True)).sum((-2, -1))
    assert float((spin / inertia)[-5:].mean()) == pytest.approx(rate, rel=0.02)
    given = -torch.cumsum(0.02 * out.wrench["ball"][1:, 5], 0)
    torch.testing.assert_close(spin[1:], given, rtol=0, atol=1e-12)


def strip_over_a_bar(mu, radius=0.04, tail=0.06, edge=0.008, **options):
    """A strip that hangs down on both sides of a bar along y: (cloth, wrapped positions)."""
    arc = math.pi * radius
    count = round((arc + 2 * tail) / edge)
    length = count * edge
    bar = Cylinder((0, -0.1, 0), (0, 0.1, 0), radius, friction=mu, **options)
    ends = {"low": tc.boundaries.Grasp(range(2)), "high": tc.boundaries.Grasp(range(2 * count, 2 * count + 2))}
    cloth = sheet({"bar": bar, **ends}, None, n=(count + 1, 2), shape=(length, edge),
                  effects={"damping": tc.effects.MassDamping(5.0)}, E=5e4)  # fmt: skip
    s = cloth.rest_state().x[:, 0] - length / 2
    angle = (s / radius).clamp(-math.pi / 2, math.pi / 2)
    over = s - radius * angle
    x = torch.stack([radius * angle.sin(), cloth.rest_state().x[:, 1], radius * angle.cos() - over.abs()], -1)
    return cloth, x


@pytest.mark.parametrize(
    ("mu", "sampling"), [(0.2, None), (0.4, None), pytest.param(0.4, 0.004, marks=pytest.mark.slow)]
)
def test_capstan(mu, sampling):
    """A strip that is pulled over half a turn of a fixed bar: tensions differ by exp(mu pi) (Euler 1769)."""
    cloth, x = strip_over_a_bar(mu, sampling=sampling)
    t = torch.linspace(0, 0.3, 13)
    pull, zero = 0.12 * t, torch.zeros(13)
    stretch = 0.025 * (t / 0.06).clamp(max=1.0)
    motion = {
        "low": path(t, torch.stack([zero, zero, pull - 0.3 * stretch], -1)),
        "high": path(t, torch.stack([zero, zero, -pull - stretch], -1)),
    }
    with torch.no_grad():
        out = cloth(cloth.state(x), motion, torch.linspace(0, 0.3, 31))
    low, high = (out.wrench[name][-10:, 2].mean() for name in ("low", "high"))
    assert float(low) > 0.01  # taut
    assert float(high / low) == pytest.approx(math.exp(mu * math.pi), rel=0.02)


@pytest.mark.parametrize("sampling", [None, 0.01])
def test_what_starts_inside_adds_little_energy(sampling):
    """A sheet put 3 cm deep into a ball leaves it at the bounded speed, instead of at depth over dt (100 m/s)."""
    ball = Sphere(0.1, (0.05, 0.05, -0.07), sampling=sampling)
    cloth = sheet({"ball": ball}, None, n=6)
    times = torch.linspace(0, 0.4, 81)
    with torch.no_grad():
        out = cloth(cloth.rest_state(), times=times)
        empty = out.state.d3
        states = [tc.ClothState(x, v, empty) for x, v in zip(out.x, out.v, strict=True)]
        energies = torch.stack([sum(cloth.energy(state).values()) for state in states])
        mass = cloth.model().mass.sum()
        depths = ball.clearance(out.x)[0].amin((-2, -1))
    assert float(depths[0]) == pytest.approx(-0.03, abs=2e-3)
    assert float(depths[-1]) > -1e-9
    assert float(energies.max()) < 4 * 0.5 * float(mass) * 0.2**2  # 2.6: it is stretched a little, too


def test_points_on_triangles_do_not_make_a_landing_bounce():
    """Impulses of many points per vertex: of the energy at 1 m/s less than a hundredth comes back (0.1 % measured)."""
    cloth = sheet({"block": Box((1.0, 1.0, 0.2), lowered(-0.1), sampling=0.01)}, n=6)
    x = cloth.rest_state().x + torch.tensor([-0.05, -0.05, 0.002])
    with torch.no_grad():
        out = cloth(cloth.state(x, torch.tensor([0.0, 0.0, -1.0]).expand_as(x)), times=torch.linspace(0, 0.03, 16))
    energy = (out.v**2).sum((-2, -1))
    assert float(energy[2:].max()) < 0.01 * float(energy[0])
    assert float(out.x[..., 2].min()) > -1e-9


@pytest.mark.parametrize(
    ("body", "vertices_alone", "sampled"),
    [
        (lambda **o: Sphere(0.08, (0, 0, -0.08), **o), 1.0, 0.2),
        (lambda **o: Capsule((-0.1, 0, -0.02), (0.1, 0, -0.02), 0.02, **o), 2.5, 0.5),
        (lambda **o: Box((0.1, 0.1, 0.1), lowered(-0.05), **o), 4.0, 2.0),
    ],
    ids=["sphere", "capsule", "box"],
)
def test_points_on_triangles_keep_small_bodies_out(body, vertices_alone, sampled):
    """A sheet of 2 cm edges draped over the body: deepest place of any triangle [mm], without points and with."""
    fine = TrianglePoints(tc.meshes.rectangle(0.2, 0.2, resolution=(11, 11)), 0.002)
    depths = []
    for sampling in (None, 0.005):
        solid = body(sampling=sampling, friction=0.3)
        damping = {"air": tc.effects.AirDrag(1.2)}
        cloth = sheet({"body": solid}, size=0.2, n=11, effects=damping, E=5e4)
        x = cloth.rest_state().x - torch.tensor([0.103, 0.102, -0.002])
        with torch.no_grad():
            out = cloth(cloth.state(x), times=torch.linspace(0, 0.25, 6))
            depths.append(-1e3 * float(solid.clearance(fine.at(out.x))[0].min()))
    assert depths[0] > vertices_alone
    assert depths[1] < sampled


def test_an_offset_is_a_thicker_body():
    thick, large = (slide(Sphere(r, (0, 0, -0.3), friction=0.3, offset=o), 0.4) for r, o in ((0.29, 0.01), (0.3, 0.0)))
    torch.testing.assert_close(thick, large, rtol=0, atol=1e-8)


def test_points_share_impulses_without_losing_momentum():
    mesh = tc.meshes.rectangle(0.1, 0.1, resolution=(5, 4))
    points = TrianglePoints(mesh, 0.008)
    x, mass = torch.as_tensor(mesh.vertices), 1 / points.mobility
    torch.manual_seed(0)
    some = torch.randn_like(points.at(x)) * (torch.rand(len(points.at(x)), 1) < 0.3)
    alone = torch.zeros_like(some)
    alone[37] = some.abs().amax(0) + 1
    torch.testing.assert_close(points.at(points.share(alone))[37], alone[37])  # one point: exactly as wanted
    same = torch.ones_like(some)
    torch.testing.assert_close(points.share(same), torch.ones_like(x), rtol=0, atol=0.15)  # all alike: nearly
    change = points.share(alone)
    linear, angular = (mass * change).sum(0), torch.linalg.cross(x, mass * change).sum(0)
    torch.testing.assert_close(angular, torch.linalg.cross(points.at(x)[37], linear))  # it acts at the point
    batch = points.share(torch.stack([some, alone]))
    torch.testing.assert_close(batch[1], change)


def test_gradients_of_a_rollout():
    """Final positions with respect to the body's path, its size and its friction."""
    cloth = sheet({"ball": Sphere(0.06, (0, 0, -0.06), friction=0.3, moving=True, sampling=0.02)}, size=0.1, n=4)
    x = cloth.rest_state().x - torch.tensor([0.052, 0.047, -0.002])
    t = torch.linspace(0, 0.02, 5)
    base = path(t, torch.stack([0.3 * t, 0.1 * t, 0.6 * t], -1), about_z(8 * t))

    def final(shift, friction, radius):
        pose = base.pose.clone()
        pose[:, :3, 3] = pose[:, :3, 3] + shift
        motion = {"ball": base._replace(pose=pose)}
        own = {"boundaries.ball.friction.raw": friction, "boundaries.ball.radius.raw": radius}
        return functional_call(cloth, own, (cloth.state(x), motion, [0.0, 0.02])).x[-1]

    ball = cloth.boundaries["ball"]
    inputs = {
        "shift": 1e-3 * torch.ones(5, 3),
        "friction": ball.friction.raw.detach(),
        "radius": ball.radius.raw.detach(),
    }
    steps = [10.0 ** (-3 - k / 2) for k in range(9)]
    check_gradients(final, inputs, 1e-6, steps)


@pytest.mark.parametrize("cell", [0.012, 0.006])
def test_a_mesh_solid_is_the_solid_that_its_mesh_draws(cell):
    """Against closed forms: a ball's surface to cell^2 / (4 r), a box's faces exactly and its edges to half a cell."""
    trimesh = pytest.importorskip("trimesh")
    torch.manual_seed(0)
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.06)
    with torch.no_grad():
        p = 0.06 * torch.nn.functional.normalize(torch.randn(2000, 3), dim=-1)
        distance, normal = MeshSolid(ball.vertices, ball.faces, cell=cell).distance(p)
        assert float(distance.abs().max()) < 1.1 * cell**2 / (4 * 0.06) + 1e-4  # the mesh itself cuts corners
        assert float(torch.linalg.cross(normal, p / 0.06).norm(dim=-1).max()) < 1.0 * cell / 0.06
        size = (0.16, 0.12, 0.1)
        p = 0.18 * (torch.rand(20000, 3) - 0.5)
        got, _ = MeshSolid(*block(size, (0, 0, 0)), cell=cell).distance(p)
        exact, _ = Box(size).distance(p)
        error = (got - exact).abs()
        near = exact.abs() < 0.003
        inner = (p.abs() - torch.tensor(size) / 2).sort(-1).values[:, 1:2] < -2 * cell  # far from edges
        assert float(error[near].max()) < 0.5 * cell
        assert float(error[near & inner].max()) < 1e-7  # open3d computes in float32


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: Sphere(0.0), "radius"),
        (lambda: Sphere(0.1, (0.0, 0.0)), "centre"),
        (lambda: Box((0.1, -0.1, 0.1)), "box size"),
        (lambda: Box((0.1, 0.1)), "box size"),
        (lambda: Box((0.1, 0.1, 0.1), 2 * torch.eye(4)), "pose"),
        (lambda: Capsule((0, 0, 0), (0, 0, 0), 0.1), "axis"),
        (lambda: Cylinder((0, 0, 0), (0, 0, 1), -0.1), "radius"),
        (lambda: Plane(normal=(0.0, 0.0, 0.0)), "plane normal"),
        (lambda: Plane(friction=-0.1), "friction"),
        (lambda: Plane(friction=Elliptic(0.3, 0.2, (0.0, 0.0, 1.0))), "friction axis"),
        (lambda: Elliptic(0.3, 0.2, (0.0, 0.0, 0.0)), "friction axis"),
        (lambda: Elliptic(0.0, 0.2), "along"),
        (lambda: Stribeck(0.4, 0.3), "static minus kinetic"),
        (lambda: Stribeck(0.3, 0.4, 0.0), "speed"),
        (lambda: Coulomb(float("nan")), "friction"),
        (lambda: Plane(offset=-1e-3), "offset"),
        (lambda: Plane(sampling=0.0), "sampling"),
        (lambda: Plane(recovery=-1.0), "recovery"),
        (lambda: MeshSolid(*_open_block()), "solid mesh"),
        (lambda: MeshSolid(*block((1, 1, 1), (0, 0, 0)), cell=0.0), "cell"),
        (lambda: MeshSolid(*block((1, 1, 1), (0, 0, 0)), cell=1e-3), "grid nodes"),
    ],
)
def test_refuses_what_is_no_body(make, word):
    with pytest.raises(InvalidInput, match=word):
        make()


def test_a_mesh_solid_without_open3d_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(MissingDependency, match="torchcloth\\[observe\\]"):
        MeshSolid(*block((1, 1, 1), (0, 0, 0)))


def _open_block():
    vertices, faces = block((1, 1, 1), (0, 0, 0))
    return vertices, faces[1:]
