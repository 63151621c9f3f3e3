"""Solid bodies against closed forms, conservation and each other."""

import math

import pytest
import torch
from helpers.collider_scenes import (
    GRAVITY_M_PER_S2,
    make_box_mesh,
    make_sheet,
    make_trajectory,
    rotate_about_z,
    simulate_sliding,
    translate_along_z,
)
from torch.func import functional_call

import torchcloth as tc
from torchcloth.boundaries import (
    Box,
    Capsule,
    Cylinder,
    Elliptic,
    MeshSolid,
    Plane,
    Sphere,
    Stribeck,
)
from torchcloth.testing import check_gradients

GROUND = {  # bodies whose highest place is flat, or nearly, at z = 0
    "plane": lambda **o: Plane(**o),
    "box": lambda **o: Box((1.0, 1.0, 0.2), translate_along_z(-0.1), **o),
    "box sampled": lambda **o: Box((1.0, 1.0, 0.2), translate_along_z(-0.1), sampling=0.01, **o),
    "cylinder's end": lambda **o: Cylinder((0, 0, -0.3), (0, 0, 0), 0.5, **o),
    "cylinder's barrel": lambda **o: Cylinder((0, -1, -1e3), (0, 1, -1e3), 1e3, **o),
    "capsule": lambda **o: Capsule((0, -1, -1e3), (0, 1, -1e3), 1e3, **o),
    "sphere": lambda **o: Sphere(1e3, (0, 0, -1e3), **o),
    "mesh": lambda **o: MeshSolid(*make_box_mesh((0.5, 0.5, 0.2), (0, 0, -0.1)), cell=0.05, **o),
}


@pytest.mark.parametrize("ground", GROUND)
def test_sticks_and_slides_on_every_solid(ground):
    mu = 0.4
    for slope, slides in ((0.9, False), (1.1, True)):
        angle = math.atan(mu * slope)
        moved, _ = simulate_sliding(GROUND[ground](friction=mu), angle)
        expected = 0.5 * GRAVITY_M_PER_S2 * (math.sin(angle) - mu * math.cos(angle)) * 0.3**2 if slides else 0.0
        assert float(moved[:, 0].mean()) == pytest.approx(expected, rel=0.01, abs=1e-5)
        assert float(moved[:, 2].abs().max()) < 1e-5  # a radius of 1 km falls by 4 um over the sheet


@pytest.mark.parametrize("degrees", [0.0, 30.0, 90.0])
def test_friction_of_a_direction(degrees):
    """Elliptical cone, not associated: the force opposes the slip; mu along 0.4, across 0.2."""
    turn = math.radians(degrees)
    mu = 0.4 / math.hypot(math.cos(turn), math.sin(turn) * 2)
    angle = math.atan(0.6)
    moved, _ = simulate_sliding(Plane(friction=Elliptic(0.4, 0.2)), angle, (math.cos(turn), math.sin(turn)))
    expected = 0.5 * GRAVITY_M_PER_S2 * (math.sin(angle) - mu * math.cos(angle)) * 0.3**2
    mean = moved.mean(0)
    assert float(mean[0] * math.cos(turn) + mean[1] * math.sin(turn)) == pytest.approx(expected, rel=0.01)
    assert float((mean[1] * math.cos(turn) - mean[0] * math.sin(turn)).abs()) < 1e-9
    moved, _ = simulate_sliding(
        Plane(friction=Elliptic(0.4, 0.2)), math.atan(0.95 * mu), (math.cos(turn), math.sin(turn))
    )
    assert float(moved.abs().max()) < 1e-9


def test_static_friction_is_overcome_once():
    """Between kinetic and static friction a sheet stays where it lies, and slides when it is pushed."""
    law = Stribeck(0.3, 0.45, 0.02)
    angle = math.atan(0.4)
    rests, _ = simulate_sliding(Plane(friction=law), angle)
    assert float(rests.abs().max()) < 1e-9
    _, v = simulate_sliding(Plane(friction=law), angle, start=0.3)
    expected = 0.3 + GRAVITY_M_PER_S2 * (math.sin(angle) - 0.3 * math.cos(angle)) * 0.3
    assert float(v[:, 0].mean()) == pytest.approx(expected, rel=0.005)


@pytest.mark.parametrize(
    "law", [lambda: Elliptic(0.35, 0.35), lambda: Stribeck(0.35, 0.35, 0.1)], ids=["elliptic", "stribeck"]
)
def test_neutral_laws_are_coulombs_bitwise(law):
    angle = math.atan(0.4)
    plain, special = (simulate_sliding(Sphere(0.3, (0, 0, -0.3), friction=f), angle, (0.6, 0.8)) for f in (0.35, law()))
    assert torch.equal(plain[0], special[0])


def test_a_conveyor_drags_a_sheet_along():
    """At mu g until the belt's speed; the belt feels the drag and the weight."""
    mu, speed = 0.3, 0.5
    cloth = make_sheet({"belt": Plane(friction=mu, moving=True)})
    motion = {"belt": make_trajectory([0.0, 1.0], [[0.0, 0.0, 0.0], [speed, 0.0, 0.0]])}
    times = torch.linspace(0, 0.3, 31)
    with torch.no_grad():
        out = cloth(cloth.rest_state(), motion, times)
    got = out.v[..., 0].mean(-1)
    torch.testing.assert_close(got, (mu * GRAVITY_M_PER_S2 * times).clamp(max=speed), rtol=1e-9, atol=5e-3 * speed)
    assert float(got[-1]) == pytest.approx(speed, rel=1e-9)
    weight = 0.15 * 0.01 * GRAVITY_M_PER_S2
    drags, follows = out.wrench["belt"][1:16], out.wrench["belt"][20:]
    torch.testing.assert_close(drags[:, :3].mean(0), torch.tensor([-mu * weight, 0, -weight]), rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(follows[:, :3].mean(0), torch.tensor([0, 0, -weight]), rtol=1e-6, atol=1e-9)


def test_a_sphere_pushed_into_a_hanging_sheet_feels_what_it_gives():
    cloth = make_sheet(
        {"top": tc.boundaries.Grasp(uv=[[0.0, 0.2], [0.2, 0.2]], radius=0.01), "ball": Sphere(0.04, moving=True)},
        (0.0, -GRAVITY_M_PER_S2, 0.0), size=0.2, n=9,
    )  # fmt: skip
    t = torch.linspace(0, 0.2, 9)
    ball = torch.stack([torch.full_like(t, 0.1), torch.full_like(t, 0.1), 0.5 * t - 0.05], -1)
    motion = {"top": make_trajectory([0.0, 0.2], [[0.0] * 3] * 2), "ball": make_trajectory(t, ball)}
    times = torch.linspace(0, 0.2, 11)
    with torch.no_grad():
        out = cloth(cloth.rest_state(), motion, times)
        mass = cloth.build_model().mass
    gained = (mass * out.v).sum(-2)
    forces = out.wrench["top"][1:, :3] + out.wrench["ball"][1:, :3]
    weight = mass.sum() * torch.tensor([0.0, -GRAVITY_M_PER_S2, 0.0])
    expected = torch.cumsum(0.02 * (weight - forces), 0)
    torch.testing.assert_close(gained[1:], expected, rtol=0, atol=1e-12)
    assert float(out.wrench["ball"][..., 2].min()) < -0.02  # the ball was pushed back
    depth = cloth.boundaries["ball"].clearance(out.x[-1], motion["ball"].pose[-1])[0].detach()
    assert -1e-5 < float(depth.min()) < 1e-3


def test_a_turning_sphere_carries_a_cap_of_cloth():
    """It comes to turn as the sphere does, and its angular momentum is what the sphere's torque gave."""
    rate, radius = 4.0, 0.1
    cloth = make_sheet({"ball": Sphere(radius, (0, 0, -radius), friction=0.5, moving=True)}, n=6)
    x = cloth.rest_state().x - torch.tensor([0.05, 0.05, -1e-4])
    t = torch.linspace(0, 0.5, 11)
    motion = {"ball": make_trajectory(t, torch.zeros(11, 3), rotate_about_z(rate * t))}
    times = torch.linspace(0, 0.5, 26)
    with torch.no_grad():
        out = cloth(cloth.state(x), motion, times)
        mass = cloth.build_model().mass
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
    cloth = make_sheet({"bar": bar, **ends}, None, n=(count + 1, 2), shape=(length, edge),
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
        "low": make_trajectory(t, torch.stack([zero, zero, pull - 0.3 * stretch], -1)),
        "high": make_trajectory(t, torch.stack([zero, zero, -pull - stretch], -1)),
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
    cloth = make_sheet({"ball": ball}, None, n=6)
    times = torch.linspace(0, 0.4, 81)
    with torch.no_grad():
        out = cloth(cloth.rest_state(), times=times)
        empty = out.state.d3
        states = [tc.ClothState(x, v, empty) for x, v in zip(out.x, out.v, strict=True)]
        energies = torch.stack([sum(cloth.energy(state).values()) for state in states])
        mass = cloth.build_model().mass.sum()
        depths = ball.clearance(out.x)[0].amin((-2, -1))
    assert float(depths[0]) == pytest.approx(-0.03, abs=2e-3)
    assert float(depths[-1]) > -1e-9
    assert float(energies.max()) < 4 * 0.5 * float(mass) * 0.2**2  # 2.6: it is stretched a little, too


def test_gradients_of_a_rollout():
    """Final positions with respect to the body's path, its size and its friction."""
    cloth = make_sheet({"ball": Sphere(0.06, (0, 0, -0.06), friction=0.3, moving=True, sampling=0.02)}, size=0.1, n=4)
    x = cloth.rest_state().x - torch.tensor([0.052, 0.047, -0.002])
    t = torch.linspace(0, 0.02, 5)
    base = make_trajectory(t, torch.stack([0.3 * t, 0.1 * t, 0.6 * t], -1), rotate_about_z(8 * t))

    def final(shift, friction, radius):
        pose = base.pose.clone()
        pose[:, :3, 3] = pose[:, :3, 3] + shift
        motion = {"ball": base._replace(pose=pose)}
        parameter = {"boundaries.ball.friction.raw": friction, "boundaries.ball.radius.raw": radius}
        return functional_call(cloth, parameter, (cloth.state(x), motion, [0.0, 0.02])).x[-1]

    ball = cloth.boundaries["ball"]
    inputs = {
        "shift": 1e-3 * torch.ones(5, 3),
        "friction": ball.friction.raw.detach(),
        "radius": ball.radius.raw.detach(),
    }
    steps = [10.0 ** (-3 - k / 2) for k in range(9)]
    check_gradients(final, inputs, 1e-6, steps, acts=True)
