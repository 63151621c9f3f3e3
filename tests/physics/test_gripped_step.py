"""What grippers hold all the time does not vibrate: small triangles in a grip shorten no step."""

from itertools import pairwise

import numpy as np
import pytest
import torch

import torchcloth as tc
from torchcloth.dynamics.stability import bound_squared_frequency, stability_limits

FRAMES_S = torch.arange(0, 0.61, 0.1)


@pytest.fixture
def cloth():
    """A sheet that a bar holds within 4 mm of its upper edge, by a row of flat triangles."""
    lines = np.array([0.0, 0.05, 0.1, 0.15, 0.196, 0.2])
    mesh = tc.meshes.rectangle(0.2, 0.2, resolution=(5, 6))
    uv = mesh.uv.copy()
    uv[:, 1] = lines[np.rint(uv[:, 1] / 0.04).astype(int)]
    mesh = tc.meshes.Mesh.build(np.pad(uv, ((0, 0), (0, 1))), mesh.faces, uv)
    gripped = np.flatnonzero(uv[:, 1] > 0.19).tolist()
    return tc.Cloth(
        mesh,
        tc.materials.AEP(youngs_modulus=2e5, poisson_ratio=0.3, thickness=1e-3),
        0.2,
        effects={"gravity": tc.effects.Gravity(), "bending": tc.effects.Bending(1e-4), "air": tc.effects.AirDrag(1.2)},
        boundaries={"bar": tc.boundaries.Grasp(gripped)},
        contact=None,
    ).double()


def swing(opens_at=None):
    """Return a trajectory of 3 cm sideways and back."""
    t = torch.linspace(0, 0.6, 61)
    pose = torch.eye(4).repeat(len(t), 1, 1)
    pose[:, 1, 3] = 0.03 * torch.sin(torch.pi * t / 0.6)
    return tc.Trajectory(t, pose, torch.ones(len(t), dtype=torch.bool) if opens_at is None else t < opens_at)


def hang(cloth):
    """Return the sheet as it hangs in the xz plane."""
    x = cloth.rest_state().x
    return cloth.state(torch.stack([x[:, 0], torch.zeros_like(x[:, 0]), x[:, 1]], 1))


def longest_substep(cloth, motion):
    schedule = cloth.schedule(hang(cloth), {"bar": motion}, FRAMES_S, None)
    return max((end - start) / n for (start, end), n in zip(pairwise(schedule.frames), schedule.counts, strict=True))


def test_a_grip_shortens_no_step_until_it_opens(cloth):
    assert longest_substep(cloth, swing()) > 3 * cloth.stable_step()
    assert longest_substep(cloth, swing(opens_at=0.5)) <= cloth.stable_step()


def test_the_longer_step_is_as_good(cloth):
    """Over half a second of swing it differs from the short one by what its own half differs."""
    motion, long = {"bar": swing()}, longest_substep(cloth, swing())
    exact, short, usual = (cloth(hang(cloth), motion, FRAMES_S, dt=dt).x for dt in (long / 32, long / 2, None))
    assert usual.isfinite().all()
    errors = [float((x - exact).norm(dim=-1).max()) for x in (short, usual)]
    assert errors[1] < 3 * errors[0]
    assert errors[1] < 1e-3


def test_the_bound_is_that_of_the_free_vertices(cloth):
    """The highest frequency of the matrix without gripped rows and columns, from the energy's second derivatives."""
    corners = cloth._find_gripped_corners({"bar": swing()})
    model = cloth.build_model()
    squared = stability_limits(model, cloth._gradient, is_gripped=corners).squared_frequency
    x = cloth.rest_state().x
    free = torch.ones(len(x), dtype=torch.bool)
    free[cloth.boundaries["bar"].index] = False

    def energy(y):
        return cloth.energy(cloth.rest_state()._replace(x=x.index_put((free.nonzero().squeeze(-1),), y)))["membrane"]

    hessian = torch.autograd.functional.hessian(energy, x[free]).flatten(2).flatten(0, 1)
    mass = model.mass[free].repeat_interleave(3)
    true = float(torch.linalg.eigvalsh(hessian / (mass[:, None] * mass).sqrt()).max())
    assert 0.3 * squared < true <= squared
    whole = bound_squared_frequency(
        cloth._gradient, model.areal_density, model.material.stiffness(model.coefficients), None
    )
    assert squared < 0.1 * whole


def test_contact_between_layers_counts_what_is_gripped(cloth):
    touching = tc.Cloth(
        cloth.mesh,
        tc.materials.AEP(youngs_modulus=2e5, poisson_ratio=0.3, thickness=1e-3),
        0.2,
        boundaries={"bar": tc.boundaries.Grasp(cloth.boundaries["bar"].index.tolist())},
        contact=tc.Contact(),
    ).double()
    assert longest_substep(touching, swing()) <= touching.stable_step()
