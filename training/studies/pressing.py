"""Two layers pressed between plates and slid over each other: what shows contact stiffness, shear stiffness and c_F.

The plates are rough: each holds one whole layer, so that nothing moves freely. The contact is without damping; nothing
then depends on the rate, and the experiment is run faster than a machine would.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

import torchcloth as tc
from torchcloth import recordings as rec
from torchcloth.robots import replay  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation

from .synthetic_sheets import readings

SIDE = 0.05  # m
APART, PRESSED, SLIDE = 2.2, 0.8, 0.4  # grid spacings: between the plates at first and at last, and sideways
DURATION = 0.016  # s: a third pressed, then slid
FRAMES = 25  # positions of the plates at which forces are read
FORCE_NOISE = 0.05  # N
STEP = 0.6  # of the stable one, in the truth


class Layer(NamedTuple):
    """SI units; moduli are as in ``AEP``."""

    youngs_modulus: float
    poisson_ratio: float
    contact_stiffness: float
    shear_stiffness: float
    cone: float
    density: float
    thickness: float = 1e-3


class Plates(NamedTuple):
    """How the experiment is made."""

    cells: int  # along a side
    spacing: float  # m, of the contact's grid
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m: where the plates are in the grid


def stack(layer: Layer, plates: Plates) -> tc.Cloth:
    """Two layers, each held by a plate in all its vertices."""
    sheet = tc.meshes.rectangle(SIDE, SIDE, resolution=(plates.cells + 1, plates.cells + 1))
    count, up = len(sheet.vertices), np.array([0.0, 0.0, APART * plates.spacing])
    mesh = tc.meshes.Mesh.build(
        np.concatenate([sheet.vertices, sheet.vertices + up]) + plates.offset,
        np.concatenate([sheet.faces, sheet.faces + count]),
    )
    material = tc.materials.AEP(**{k: v for k, v in layer._asdict().items() if k != "density"})
    grasps = {"below": tc.boundaries.Grasp(range(count)), "above": tc.boundaries.Grasp(range(count, 2 * count))}
    return tc.Cloth(mesh, material, layer.density, {}, grasps, tc.Contact(plates.spacing, damping=0.0))


def motion(plates: Plates) -> dict[str, rec.GripperMotion]:
    """The upper plate comes down, then slides along x; the lower one is still."""
    t = np.linspace(0.0, DURATION, 4 * (FRAMES - 1) + 1)
    down, aside = (0.5 * (1 - np.cos(np.pi * np.clip(s, 0, 1))) for s in (3 * t / DURATION, 1.5 * t / DURATION - 0.5))
    above = np.zeros((len(t), 3))
    above[:, 2] = (APART + (PRESSED - APART) * down) * plates.spacing
    above[:, 0] = SLIDE * aside * plates.spacing
    facing, closed = np.tile([1.0, 0, 0, 0], (len(t), 1)), np.ones(len(t), bool)
    paths = {"below": np.zeros((len(t), 3)), "above": above}
    return {name: rec.GripperMotion(t, x + plates.offset, facing, closed) for name, x in paths.items()}


def record(layer: Layer, plates: Plates, seed: int) -> rec.Recording:
    """The experiment as a recording without cloth."""
    rng = np.random.default_rng(seed)
    cloth, paths = stack(layer, plates), motion(plates)
    recording = rec.Recording(
        cloth=rec.ClothInfo(areal_density=layer.density),
        provenance="synthetic: torchcloth, the same law on another mesh, with another step",
        grippers=paths,
    )
    knots = paths["above"].t
    with torch.no_grad():
        out = cloth(cloth.rest_state(), replay(recording), knots.tolist(), dt=STEP * cloth.stable_step())
    felt = {
        name: replace(m, force=readings(out, name, knots, FORCE_NOISE, rng), position=m.position - plates.offset)
        for name, m in paths.items()
    }
    return replace(recording, grippers=felt)


def on_model(recording: rec.Recording, cloth: tc.Cloth) -> rec.Recording:
    """The recording for a model: its mesh, and where the camera saw the layers' corners, which gives the frames."""
    t = recording.grippers["above"].t[::4]
    count = len(cloth.mesh.vertices) // 2
    corner = int(np.argmin(cloth.mesh.vertices[count:, :2].sum(1))) + count
    moved = recording.grippers["above"].position[::4] - recording.grippers["above"].position[0]
    seen = cloth.mesh.vertices[corner] + moved
    info = replace(recording.cloth, vertices=cloth.mesh.vertices, faces=cloth.mesh.faces, thickness=1e-3)
    points = rec.PointClouds(t, seen, np.ones(len(t), int))
    return replace(recording, cloth=info, points=points, observation_noise_std=1e-3)
