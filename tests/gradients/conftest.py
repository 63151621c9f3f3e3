"""Small sheets in smooth motion: no vertex changes side of a switch within the reach of the sweeps."""

from types import SimpleNamespace

import pytest
import torch

import torchcloth as tc


def turning(start, duration, speed=1.5, rate=3.0):
    """[4 knots] a body that starts at ``start``, travels and turns."""
    t = torch.linspace(0.0, duration, 4)
    pose = torch.eye(4).repeat(4, 1, 1)
    angle = rate * t**2 / duration
    pose[:, 0, 0] = pose[:, 1, 1] = angle.cos()
    pose[:, 1, 0], pose[:, 0, 1] = angle.sin(), -angle.sin()
    pose[:, :3, 3] = start + speed * (t**2 / duration)[:, None] * torch.tensor([0.3, -0.2, 1.0])
    return tc.Trajectory(t, pose, torch.ones(4, dtype=torch.bool))


@pytest.fixture
def swing():
    """A sheet held by two vertices, blown through the air; every effect; no contact; 40 substeps."""
    torch.manual_seed(0)
    effects = {
        "gravity": tc.effects.Gravity(),
        "air": tc.effects.AirDrag(1.2),
        "bending": tc.effects.Bending(1e-4, damping_time=1e-3),
        "damping": tc.effects.MassDamping(2.0),
    }
    mesh = tc.meshes.rectangle(0.2, 0.24, resolution=(4, 5))
    boundaries = {"hand": tc.boundaries.Grasp([0, 1])}
    cloth = tc.Cloth(mesh, tc.materials.AEP(1e5, 0.3), 0.2, effects, boundaries, contact=None)
    dt = 0.6 * cloth.stable_step()
    u, v = torch.as_tensor(mesh.uv).T
    x = cloth.rest_state().x + torch.stack([0 * u, 0.02 * u, 0.3 * u * v + 0.5 * u**2], dim=-1)
    x = x + 1e-3 * torch.randn_like(x)
    velocity = torch.tensor([0.2, 0.1, 2.0]) + 0.2 * torch.randn_like(x)  # v_n > 0 throughout: drag stays smooth
    times = torch.linspace(0.0, 40 * dt, 3).tolist()
    motion = {"hand": turning(x[0], times[-1])}
    return SimpleNamespace(cloth=cloth, state=cloth.state(x, velocity), motion=motion, times=times, dt=dt)


@pytest.fixture
def pressed():
    """A sheet whose directors are compressed, half of them sliding on the cone, half of them sticking; 16 substeps."""
    torch.manual_seed(0)
    mesh = tc.meshes.rectangle(0.2, 0.2, resolution=(4, 4))
    cloth = tc.Cloth(
        mesh,
        tc.materials.AEP(1e5, 0.3, contact_stiffness=1e5, shear_stiffness=5e4, cone=0.3),
        0.2,
        contact=tc.Contact(everywhere=True, free_compression=0.1),
    )
    dt = 0.4 * cloth.stable_step()
    x = cloth.rest_state().x + 4e-3 * torch.randn(16, 3)
    state = cloth.state(x, 0.3 * torch.randn(16, 3))
    aside = torch.nn.functional.normalize(
        torch.linalg.cross(state.d3, torch.tensor([0.6, 0.8, 0.0]).expand_as(state.d3)), dim=-1
    )
    slides = torch.arange(len(state.d3))[:, None] % 2 == 0
    d3 = 0.5 * state.d3 + torch.where(slides, 0.4, 0.02) * aside
    times = [0.0, 16 * dt]
    return SimpleNamespace(cloth=cloth, state=state._replace(d3=d3), motion={}, times=times, dt=dt)
