"""Two layers pressed between plates and slid over each other, to measure contact stiffness, shear stiffness and c_F.

The plates are rough: each holds one whole layer, so nothing moves freely. The contact has no damping, so nothing
depends on the rate. The experiment is therefore run faster than on a machine.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation

import torchcloth as tc
from torchcloth import recordings as rec
from torchcloth.robots import replay  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation

from .synthetic_sheets import simulate_readings

LAYER_SIDE_M = 0.05
INITIAL_DISTANCE_SPACINGS, PRESSED_DISTANCE_SPACINGS = 2.2, 0.8  # of the plates, in grid spacings
SLIDE_SPACINGS = 1.2  # sideways motion of the upper plate, in grid spacings
DURATION_S = 0.016  # a third for pressing, then sliding
FORCE_SAMPLES = 25
FORCE_NOISE_N = 0.05
STEP_FRACTION = 0.6  # of the stable step, in the truth


class Layer(NamedTuple):
    """Parameters of a layer in SI units; see ``AEP``."""

    youngs_modulus: float
    poisson_ratio: float
    contact_stiffness: float
    shear_stiffness: float
    cone: float
    density: float
    thickness: float = 1e-3


class Plates(NamedTuple):
    """Discretisation of the experiment.

    Attributes:
        cells: along a side.
        spacing: of the contact grid [m].
        offset: position of the plates in the grid [m].
        turn: rotation vector of the plates in the grid [rad].
    """

    cells: int
    spacing: float
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def rotation(self) -> Rotation:
        """The turn as a rotation."""
        return Rotation.from_rotvec(self.turn)

    def moved_randomly(self, rng: np.random.Generator) -> Plates:
        """Return plates at any place and in any attitude in the grid."""
        turn = Rotation.random(None, rng).as_rotvec()
        return self._replace(offset=tuple(rng.uniform(0, self.spacing, 3)), turn=tuple(turn))


def build_layers(layer: Layer, plates: Plates) -> tc.Cloth:
    """Build two layers, each held by a plate at all its vertices."""
    sheet = tc.meshes.rectangle(LAYER_SIDE_M, LAYER_SIDE_M, resolution=(plates.cells + 1, plates.cells + 1))
    count, up = len(sheet.vertices), np.array([0.0, 0.0, INITIAL_DISTANCE_SPACINGS * plates.spacing])
    mesh = tc.meshes.Mesh.build(
        plates.rotation.apply(np.concatenate([sheet.vertices, sheet.vertices + up])) + plates.offset,
        np.concatenate([sheet.faces, sheet.faces + count]),
    )
    material = tc.materials.AEP(**{k: v for k, v in layer._asdict().items() if k != "density"})
    grasps = {"below": tc.boundaries.Grasp(range(count)), "above": tc.boundaries.Grasp(range(count, 2 * count))}
    return tc.Cloth(mesh, material, layer.density, {}, grasps, tc.Contact(plates.spacing, damping=0.0))


def plate_motion(plates: Plates) -> dict[str, rec.GripperMotion]:
    """Return the paths of the plates: the upper one comes down, then slides along x; the lower one stands still."""
    t = np.linspace(0.0, DURATION_S, 4 * (FORCE_SAMPLES - 1) + 1)
    down, aside = (
        0.5 * (1 - np.cos(np.pi * np.clip(s, 0, 1))) for s in (3 * t / DURATION_S, 1.5 * t / DURATION_S - 0.5)
    )
    above = np.zeros((len(t), 3))
    above[:, 2] = (
        INITIAL_DISTANCE_SPACINGS + (PRESSED_DISTANCE_SPACINGS - INITIAL_DISTANCE_SPACINGS) * down
    ) * plates.spacing
    above[:, 0] = SLIDE_SPACINGS * aside * plates.spacing
    quaternion_wxyz = np.roll(plates.rotation.as_quat(), 1)
    facing, closed = np.tile(quaternion_wxyz, (len(t), 1)), np.ones(len(t), bool)
    paths = {"below": np.zeros((len(t), 3)), "above": above}
    return {
        name: rec.GripperMotion(t, plates.rotation.apply(x) + plates.offset, facing, closed)
        for name, x in paths.items()
    }


def record(layer: Layer, plates: Plates, seed: int) -> rec.Recording:
    """Simulate the experiment and return a recording without cloth, in the frame of the plates."""
    rng = np.random.default_rng(seed)
    cloth, paths = build_layers(layer, plates), plate_motion(plates)
    recording = rec.Recording(
        cloth=rec.ClothInfo(areal_density=layer.density),
        provenance="synthetic: torchcloth, the same law on another mesh, with another step",
        grippers=paths,
    )
    knots = paths["above"].t
    with torch.no_grad():
        out = cloth(cloth.rest_state(), replay(recording), knots.tolist(), dt=STEP_FRACTION * cloth.stable_step())
    forces = {name: simulate_readings(out, name, knots, FORCE_NOISE_N, rng) for name in paths}
    measured = {
        name: replace(m, force=plates.rotation.inv().apply(forces[name]))
        for name, m in plate_motion(plates._replace(offset=(0.0, 0.0, 0.0), turn=(0.0, 0.0, 0.0))).items()
    }
    return replace(recording, grippers=measured)


def place_on_model(recording: rec.Recording, cloth: tc.Cloth) -> rec.Recording:
    """Return the recording with a model's mesh and one observed corner, whose times define the frames."""
    t = recording.grippers["above"].t[::4]
    count = len(cloth.mesh.vertices) // 2
    corner = int(np.argmin(cloth.mesh.vertices[count:, :2].sum(1))) + count
    moved = recording.grippers["above"].position[::4] - recording.grippers["above"].position[0]
    corner_path = cloth.mesh.vertices[corner] + moved
    info = replace(recording.cloth, vertices=cloth.mesh.vertices, faces=cloth.mesh.faces, thickness=1e-3)
    points = rec.PointClouds(t, corner_path, np.ones(len(t), int))
    return replace(recording, cloth=info, points=points, observation_noise_std=1e-3)
