"""Cloths and motions for tests of the engine."""

import torch

import torchcloth as tc


def make_sheet(engine="auto", *, effects=None, boundaries=None, material=None, n=5, **options):
    """Return a small sheet with weight, drag, bending and two grasps."""
    mesh = tc.meshes.rectangle(0.2, 0.2, resolution=(n, n))
    if effects is None:
        effects = {
            "gravity": tc.effects.Gravity(),
            "air": tc.effects.AirDrag(1.2, tangential=0.02, wind=(0.3, 0.1, 0.0)),
            "bending": tc.effects.Bending(1e-4, damping_time=1e-3),
            "damping": tc.effects.MassDamping(0.4),
        }
    if boundaries is None:
        boundaries = {"left": tc.boundaries.Grasp([0, 1]), "right": tc.boundaries.Grasp([n - 1])}
    options.setdefault("contact", None)
    return tc.Cloth(mesh, material or tc.materials.AEP(1e5, 0.3), 0.2, effects, boundaries, engine=engine, **options)


def make_opening_motion(end, name_of_flags="left"):
    """Return two moving grippers; one opens and closes again between the frames."""
    t = torch.linspace(0.0, end, 7)
    motion = {}
    for sign, name in ((1, "left"), (-1, "right")):
        pose = torch.eye(4).repeat(7, 1, 1)
        angle = 2 * sign * t
        pose[:, 0, 0] = pose[:, 1, 1] = angle.cos()
        pose[:, 1, 0], pose[:, 0, 1] = angle.sin(), -angle.sin()
        pose[:, 2, 3], pose[:, 0, 3] = 0.5 * t**2 / end, 0.1 * sign * t
        closed = torch.tensor([1, 1, 0, 0, 1, 1, 1], dtype=torch.bool)
        motion[name] = tc.Trajectory(t, pose, closed if name == name_of_flags else torch.ones(7, dtype=torch.bool))
    return motion


def make_perturbed_state(cloth, batch=()):
    """Return a state with random displacements and velocities."""
    generator = torch.Generator().manual_seed(0)
    x = cloth.rest_state().x.expand(*batch, -1, -1)
    x = x + 1e-3 * torch.randn(x.shape, generator=generator, dtype=torch.float64).to(x)
    v = 0.3 * torch.randn(x.shape, generator=generator, dtype=torch.float64).to(x)
    return cloth.state(x, v)


def check_close(a, b, tolerance, what):
    """Check that the relative error in the norm is small."""
    error = float((a - b).detach().norm() / b.detach().norm().clamp(min=1e-300))
    assert error < tolerance, f"{what}: {error:.2e}"
