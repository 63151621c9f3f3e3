"""A plate that swings about its upper edge against the closed form of a rigid one: period with air, decay by drag."""

import math

import pytest
import torch

import torchcloth as tc

LENGTH, WIDTH, DENSITY, RHO = 0.2, 0.1, 0.15, 1.204  # m, m, kg/m^2, kg/m^3
G, START = 9.81, 0.25  # m/s^2, rad


def swing(effects, seconds):
    """(times, angle) of a plate that hangs by one line of vertices, which is a hinge, let go at ``START``."""
    mesh = tc.meshes.rectangle(WIDTH, LENGTH, resolution=(3, 7))
    upper = mesh.vertices[:, 1].max()
    parts = {"gravity": tc.effects.Gravity((0.0, 0.0, -G)), "bending": tc.effects.Bending(0.03), **effects}
    top = (mesh.vertices[:, 1] > upper - 1e-9).nonzero()[0].tolist()
    cloth = tc.Cloth(
        mesh, tc.materials.AEP(1e6, 0.3), DENSITY, parts, {"clamp": tc.boundaries.Grasp(top)}, contact=None
    )
    down = upper - torch.as_tensor(mesh.vertices[:, 1])
    x = torch.stack([torch.as_tensor(mesh.vertices[:, 0]), down * math.sin(START), -down * math.cos(START)], 1).to(
        cloth.rest_state().x
    )
    still = tc.Trajectory(torch.tensor([0.0, 9.0]), torch.eye(4).repeat(2, 1, 1), torch.ones(2, dtype=bool))
    times = torch.linspace(0.0, seconds, round(seconds * 200) + 1)
    with torch.no_grad():
        out = cloth(cloth.state(x), {"clamp": still}, times=times)
    tip = out.x[:, down > LENGTH - 1e-9].mean(1)
    return times, torch.atan2(tip[:, 1], -tip[:, 2])


def turns(times, angle):
    """(times, sizes) of the extremes, by parabolas through three samples."""
    k = ((angle[1:-1] - angle[:-2]) * (angle[2:] - angle[1:-1]) < 0).nonzero().flatten() + 1
    a, b, c = angle[k - 1], angle[k], angle[k + 1]
    off = 0.5 * (a - c) / (a - 2 * b + c)
    return times[k] + off * (times[1] - times[0]), (b - 0.25 * (a - c) * off).abs()


def period(added=0.0):
    """s, of a rigid plate at an amplitude START: 2 pi sqrt(2 L / 3 g), gravity pulls at the plate alone."""
    small = 2 * math.pi * math.sqrt(2 * LENGTH / (3 * G) * (1 + added / DENSITY))
    return small * (1 + START**2 / 16)


@pytest.mark.parametrize("depth", [0.0, 0.1])
def test_air_that_goes_with_it_slows_it(depth):
    """The air along the normal has as much inertia about the hinge as a plate of density rho depth."""
    effects = {"added": tc.effects.AddedMass(depth)} if depth else {}
    times, _ = turns(*swing(effects, 1.8))
    assert 2 * float((times[1:] - times[:-1]).mean()) == pytest.approx(period(RHO * depth), rel=0.01)


def test_drag_takes_of_the_amplitude_by_its_square():
    """theta'' + w^2 theta + k theta'|theta'| = 0 with k = 3 rho C L / (8 rho_A): A' = -(4 / 3 pi) k w A^2."""
    drag = 1.2
    free, air = (turns(*swing(effects, 2.6)) for effects in ({}, {"air": tc.effects.AirDrag(drag, density=RHO)}))
    k = 3 * RHO * drag * LENGTH / (8 * DENSITY)
    rate = 4 / (3 * math.pi) * k * 2 * math.pi / period()
    # by the slope of 1 / A, less what the scheme takes without air
    slope = [float((1 / size[-1] - 1 / size[0]) / (t[-1] - t[0])) for t, size in (free, air)]
    assert abs(slope[0]) < 0.05 * rate
    assert slope[1] - slope[0] == pytest.approx(rate, rel=0.05)
