"""Make the shipped example: two Rizon 4 swing a knitted cloth that MuJoCo simulates and an Azure Kinect observes.

    python -m torchcloth.training.validation.independent.make_example [--out DIR] [--seed 0]

The truth comes from another engine (see mujoco_cloth.py) on a mesh and a time step of its own. The same seed and
the same versions of mujoco, numpy, scipy, open3d and torch on the same kind of machine give the same numbers bit by
bit. Other versions may round differently.

The fabric is an acrylic rib knit, course direction: Y = 50 N/m, secant at 10 % strain (Singal et al. 2024, Nat.
Commun. 15:2622). Here it is the small-strain stiffness of a Saint Venant-Kirchhoff membrane, which stiffens: its
secant at 10 % is 15.5 % higher. Weight, bending and damping of a heavy knit are our choice. A lighter, stiffer
sheet that is pulled harder wrinkles at the size of any mesh. Then no two engines, nor two runs, agree, and nothing can
be learnt from the episode.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchcloth import recordings
from torchcloth.robots import bimanual_rig  # pyright: ignore[reportMissingImports] - mapped from robots/

from .first_frame import measured_mesh
from .flex_sheet import SheetSpec, sheet_mesh
from .kinect_camera import CameraPlacement, arm_mesh_function, observe_cloth
from .mujoco_cloth import Grip, MujocoCloth, Result, mujoco_version, settle
from .swing_motion import ARM_SIDES, Swing, measure_joint_usage, solve_joint_positions, tool_poses

Array = np.ndarray
REPOSITORY = Path(__file__).resolve().parents[3]
PROGRAM = "training/validation/independent/make_example.py"  # in the provenance
SIDE_M = 0.40
GRASP_POINTS_M = {"left": (0.0, SIDE_M), "right": (SIDE_M, SIDE_M)}  # material coordinates
GRASP_RADIUS_M = 0.026  # a finger pad of 15 x 38 mm, across its diagonal
DIAGONAL_M = GRASP_RADIUS_M / 2**0.5  # a vertex there makes the held patch round
NOMINAL_VALUES = {  # a data sheet: a start for fits, wrong in stiffness and Poisson ratio
    "membrane_stiffness": 150.0,
    "youngs_modulus": 1.5e5,
    "poisson_ratio": 0.15,
    "bending_stiffness": 3e-5,
    "bending_damping_time": 0.005,
    "units": {
        "membrane_stiffness": "N/m",
        "youngs_modulus": "Pa",
        "poisson_ratio": "-",
        "bending_stiffness": "N m",
        "bending_damping_time": "s",
    },
}


def make_knit(nodes: int) -> SheetSpec:
    """Return the cloth of ``nodes`` x ``nodes`` vertices.

    Grid lines lie at the edges of the held patches, so that these are round. Bending and damping are those of a fabric:
    without them wrinkles as fine as the mesh grow, and no time step converges.
    """
    width = height = SIDE_M
    return SheetSpec(
        width,
        height,
        nodes=(nodes, nodes),
        areal_density=0.35,
        membrane_stiffness=50.0,
        drag_normal=1.2,
        bending_stiffness=3e-5,
        damping_time=5e-3,
        lines_u=(
            *(0.0, DIAGONAL_M),
            *np.linspace(GRASP_RADIUS_M, width - GRASP_RADIUS_M, nodes - 4),
            *(width - DIAGONAL_M, width),
        ),
        lines_v=(*np.linspace(0.0, height - GRASP_RADIUS_M, nodes - 2), height - DIAGONAL_M, height),
    )


@dataclass(frozen=True)
class ExampleSettings:
    """All choices that make the episode.

    Attributes:
        seed: of all noise.
        sheet: the true cloth.
        step: s, of the simulation.
        settling: s, simulated before the motion.
        swing: the motion.
        camera: its placement and noise.
        knots_per_frame: of the motion; 4 give 25 Hz.
        fit_nodes: vertices along each side of the mesh that a fit uses.
        initial_error: m, of the first positions, along the cloth's normal.
        force_noise: N, standard deviation.
        torque_noise: N m, standard deviation.
    """

    seed: int = 0
    sheet: SheetSpec = field(default_factory=lambda: make_knit(25))
    step: float = 5e-5
    settling: float = 2.0
    swing: Swing = field(default_factory=lambda: Swing(stretch=0.02))
    camera: CameraPlacement = field(default_factory=CameraPlacement)
    knots_per_frame: int = 4
    fit_nodes: int = 17
    initial_error: float = 1e-3
    force_noise: float = 0.05
    torque_noise: float = 0.005


def simulate(
    settings: ExampleSettings, t: Array, poses: dict[str, Array], rng: np.random.Generator
) -> tuple[Result, Array]:
    """Simulate the cloth from rest; returns its motion at knots t [K] s and its triangles [F, 3]."""
    uv, faces = sheet_mesh(settings.sheet)
    x0 = hanging_shape(settings, uv, rng)
    grips = {}
    for name, pose in poses.items():
        distance = np.linalg.norm(uv - GRASP_POINTS_M[name], axis=1)
        grips[name] = Grip(np.flatnonzero(distance <= GRASP_RADIUS_M * (1 + 1e-9)), t, pose)
    rest = settle(settings.sheet, x0, grips, settings.settling)
    return MujocoCloth(settings.sheet, settings.step).run(rest, t, grips), faces


def hanging_shape(settings: ExampleSettings, uv: Array, rng: np.random.Generator) -> Array:
    """Return a flat sheet [V, 3] m between the grippers, with a slight random bulge to settle from."""
    sheet, (x, z) = settings.sheet, settings.swing.centre
    a, b = uv[:, 0] / sheet.width, uv[:, 1] / sheet.height
    bulge = sum(rng.standard_normal() * np.sin(np.pi * k * a) for k in range(1, 4)) * (1 - b)
    y = settings.swing.distance / 2 * (1 - 2 * a)
    return np.stack([x + 2e-3 * bulge, y, z + uv[:, 1] - sheet.height], 1)


def fit_mesh(settings: ExampleSettings, x: Array, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Return material coordinates [V, 2] m, triangles [F, 3] and measured first positions [V, 3] m of a fit's mesh."""
    points = list(GRASP_POINTS_M.values())
    return measured_mesh(settings.sheet, x, settings.fit_nodes, settings.initial_error, points, GRASP_RADIUS_M, rng)


def make_example(settings: ExampleSettings) -> tuple[recordings.Recording, dict[str, Any]]:
    """Return the episode, and figures about it."""
    torch.set_num_threads(1)
    shape_rng, points_rng, noise_rng = (np.random.default_rng([settings.seed, k]) for k in range(3))
    rig = bimanual_rig(model="rizon4", frame="tcp_closed")
    t = settings.swing.times()
    q = solve_joint_positions(rig, settings.swing.poses(t))
    usage = measure_joint_usage(rig, t, q)
    result, faces = simulate(settings, t, tool_poses(rig, q), shape_rng)
    frames = np.arange(0, len(t), settings.knots_per_frame)
    arm_meshes = arm_mesh_function(rig, {name: value[frames] for name, value in q.items()})
    view = settings.camera.make_view()
    points, sigma, visible = observe_cloth(view, t[frames], result.x[frames], faces, arm_meshes, points_rng)
    figures = {
        **usage,
        "grasp_error": result.grasp_error,
        "visible_fraction": (visible.min(), visible.max()),
        "noise": sigma,
        "force": max(float(np.linalg.norm(f, axis=1).max()) for f in result.force.values()),
        "strain": upper_edge_strain(settings.sheet, result.x),
    }
    truth = recordings.Truth(
        t[frames], result.x[frames].astype(np.float32), faces.astype(np.int32), _true_parameters(settings)
    )
    recording = recordings.Recording(
        cloth=_cloth_info(settings, *fit_mesh(settings, result.x[0], noise_rng)),
        provenance=f"synthetic: MuJoCo flex {mujoco_version()}, {PROGRAM}, seed {settings.seed}",
        licence="CC0-1.0",
        grasps={name: recordings.GraspInfo(np.array([p]), GRASP_RADIUS_M) for name, p in GRASP_POINTS_M.items()},
        joints={name: _joint_motion(settings, t, q[name], result, name, noise_rng) for name in ARM_SIDES},
        robots={name: recordings.RobotInfo("rizon4", rig[name].base.numpy(), "tcp_closed") for name in ARM_SIDES},
        cameras={"cam0": _camera(settings)},
        points=points,
        truth=truth,
        observation_noise_std=round(sigma, 5),
        gravity=np.array([0.0, 0.0, settings.sheet.gravity]),
        air_density=settings.sheet.air_density,
        split={"motion": "bimanual_swing", "replicate_of": None},
    )
    return recording, figures


def upper_edge_strain(sheet: SheetSpec, x: Array) -> tuple[float, float]:
    """Return the smallest and largest strain of the upper edge over the frames [T, V, 3] m."""
    edge = x.reshape(len(x), sheet.nodes[1], sheet.nodes[0], 3)[:, -1]
    strain = np.linalg.norm(np.diff(edge, axis=1), axis=-1).sum(1) / sheet.width - 1
    return float(strain.min()), float(strain.max())


def _cloth_info(settings: ExampleSettings, uv: Array, faces: Array, first: Array) -> recordings.ClothInfo:
    sheet = settings.sheet
    return recordings.ClothInfo(
        areal_density=sheet.areal_density,
        areal_density_std=0.005,
        thickness=1e-3,
        initial_vertices=first,
        vertices=np.column_stack([uv, np.zeros(len(uv))]),
        faces=faces,
        uv=uv,
        nominal=dict(NOMINAL_VALUES),
    )


def _camera(settings: ExampleSettings) -> recordings.Camera:
    camera = settings.camera.make_camera()
    return recordings.Camera(width=camera.width, height=camera.height, K=camera.K, T_world_camera=camera.T_world_camera)


def _true_parameters(settings: ExampleSettings) -> dict[str, Any]:
    """Return the true parameters, for scoring: they go into truth.npz, which no fit reads."""
    sheet = settings.sheet
    return {
        "membrane_stiffness": np.float64(sheet.membrane_stiffness),
        "poisson_ratio": np.float64(sheet.poisson_ratio),
        "bending_stiffness": np.float64(sheet.bending_stiffness),
        "damping_time": np.float64(sheet.damping_time),
        "drag_normal": np.float64(sheet.drag_normal),
        "areal_density": np.float64(sheet.areal_density),
    }


def _joint_motion(
    settings: ExampleSettings, t: Array, q: Array, result: Result, name: str, rng: np.random.Generator
) -> recordings.JointMotion:
    noise = rng.standard_normal((2, len(t), 3))
    return recordings.JointMotion(
        t,
        q,
        closed=np.ones(len(t), bool),
        width=np.zeros(len(t)),
        force=(result.force[name] + settings.force_noise * noise[0]).round(4),
        torque=(result.torque[name] + settings.torque_noise * noise[1]).round(5),
    )


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=REPOSITORY / "torchcloth" / "examples" / "bimanual_swing")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--fit-nodes", type=int, default=17, help="vertices along each side of cloth.obj")
    parser.add_argument("--overwrite", action="store_true")
    args = parser.parse_args()
    recording, figures = make_example(ExampleSettings(seed=args.seed, fit_nodes=args.fit_nodes))
    folder = recordings.write(recording, args.out, overwrite=args.overwrite)
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    print(f"{folder}: {size / 1e6:.2f} MB")
    for key, value in figures.items():
        print(f"  {key}: {np.round(value, 5)}")


if __name__ == "__main__":
    main()
