"""Makes the packaged example: two Rizon 4 swing a knitted cloth, simulated by MuJoCo, seen by an Azure Kinect.

    python -m torchcloth.training.validation.independent.make_example [--out torchcloth/examples/bimanual_swing] [--seed 0]

Truth comes from another engine (see mujoco_cloth.py) on a mesh and a time step of its own. The same seed and the same
versions of mujoco, numpy, scipy, open3d and torch on the same kind of machine give the same numbers bit by bit; other
versions may round differently.

The fabric is an acrylic rib knit, course direction: Y = 50 N/m, secant at 10 % strain (Singal et al. 2024, Nat.
Commun. 15:2622). Here it is the small-strain stiffness of a Saint Venant-Kirchhoff membrane, which stiffens: its
secant at 10 % is 15.5 % higher. Weight, bending and damping of a heavy knit are ours. A lighter, stiffer sheet pulled
harder wrinkles at the size of any mesh, and then no two engines, nor two runs, agree: such an episode teaches nothing.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from torchcloth import recordings, robots

from .first_frame import measured_mesh
from .flex_sheet import SheetSpec, grid
from .kinect_camera import Place, arm_meshes, observe_cloth
from .mujoco_cloth import Grip, MujocoCloth, Result, mujoco_version, settle
from .swing_motion import SIDE, Swing, demands, forward, joints

Array = np.ndarray
ROOT = Path(__file__).resolve().parents[3]
CORNER = {"left": (0.0, 0.40), "right": (0.40, 0.40)}  # m, material coordinates
RADIUS = 0.026  # m, a finger pad of 15 x 38 mm across its diagonal
DIAGONAL = RADIUS / 2**0.5  # m, a vertex there makes the held patch round
NOMINAL = {  # a data sheet: a start for fits, wrong in stiffness and Poisson ratio
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


def knit(nodes: int) -> SheetSpec:
    """The cloth, with lines of its ``nodes`` x ``nodes`` vertices where the held patches end, so that these are round.

    Bending and damping, as fabric has: without them wrinkles as fine as the mesh grow, and no time step converges.
    """
    width = height = 0.40
    return SheetSpec(
        width,
        height,
        nodes=(nodes, nodes),
        areal_density=0.35,
        membrane_stiffness=50.0,
        drag_normal=1.2,
        bending_stiffness=3e-5,
        damping_time=5e-3,
        lines_u=(0.0, DIAGONAL, *np.linspace(RADIUS, width - RADIUS, nodes - 4), width - DIAGONAL, width),
        lines_v=(*np.linspace(0.0, height - RADIUS, nodes - 2), height - DIAGONAL, height),
    )


@dataclass(frozen=True)
class Plan:
    """All choices that make the episode."""

    seed: int = 0
    sheet: SheetSpec = field(default_factory=lambda: knit(25))
    step: float = 5e-5  # s
    settling: float = 2.0  # s
    swing: Swing = field(default_factory=lambda: Swing(stretch=0.02))
    place: Place = field(default_factory=Place)
    every: int = 4  # motion knots per frame: 25 Hz
    fit_nodes: int = 17
    initial_error: float = 1e-3  # m, along the cloth's normal
    force_noise: float = 0.05  # N
    torque_noise: float = 0.005  # N m


def simulate(plan: Plan, t: Array, poses: dict[str, Array], rng: np.random.Generator) -> tuple[Result, Array]:
    """The cloth at the motion's knots, started at rest, and its triangles [F, 3]."""
    uv, faces = grid(plan.sheet)
    x0 = hanging(plan, uv, rng)
    grips = {}
    for name, pose in poses.items():
        held = np.flatnonzero(np.linalg.norm(uv - CORNER[name], axis=1) <= RADIUS * (1 + 1e-9))
        grips[name] = Grip(held, t, pose)
    rest = settle(plan.sheet, x0, grips, plan.settling)
    return MujocoCloth(plan.sheet, plan.step).run(rest, t, grips), faces


def hanging(plan: Plan, uv: Array, rng: np.random.Generator) -> Array:
    """A flat sheet [V, 3] m between the grippers, corners at their places, with a slight random bulge to settle
    from.
    """
    sheet, (x, z) = plan.sheet, plan.swing.centre
    a, b = uv[:, 0] / sheet.width, uv[:, 1] / sheet.height
    bulge = sum(rng.standard_normal() * np.sin(np.pi * k * a) for k in range(1, 4)) * (1 - b)
    y = plan.swing.apart / 2 * (1 - 2 * a)
    return np.stack([x + 2e-3 * bulge, y, z + uv[:, 1] - sheet.height], 1)


def fit_mesh(plan: Plan, x: Array, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Material coordinates [V, 2], triangles [F, 3] and measured first positions [V, 3] m of a fit's mesh."""
    return measured_mesh(plan.sheet, x, plan.fit_nodes, plan.initial_error, list(CORNER.values()), RADIUS, rng)


def make(plan: Plan) -> tuple[recordings.Recording, dict[str, object]]:
    """The episode, and figures about it worth printing."""
    torch.set_num_threads(1)
    start, seen, measured = (np.random.default_rng([plan.seed, k]) for k in range(3))
    rig = robots.bimanual_rig(model="rizon4", frame="tcp_closed")
    t = plan.swing.times()
    q = joints(rig, plan.swing.poses(t))
    load = demands(rig, t, q)
    result, faces = simulate(plan, t, forward(rig, q), start)
    frames = np.arange(0, len(t), plan.every)
    shapes = arm_meshes(rig, {name: value[frames] for name, value in q.items()})
    points, sigma, share = observe_cloth(plan.place.view(), t[frames], result.x[frames], faces, shapes, seen)
    facts = {
        **load,
        "grasp_error": result.grasp_error,
        "seen": (share.min(), share.max()),
        "noise": sigma,
        "force": max(float(np.linalg.norm(f, axis=1).max()) for f in result.force.values()),
        "strain": upper_edge_strain(plan.sheet, result.x),
    }
    truth = recordings.Truth(t[frames], result.x[frames].astype(np.float32), faces.astype(np.int32), _parameters(plan))
    recording = recordings.Recording(
        cloth=_cloth(plan, *fit_mesh(plan, result.x[0], measured)),
        provenance=f"synthetic: MuJoCo flex {mujoco_version()}, training/validation/independent/make_example.py, seed {plan.seed}",
        licence="CC0-1.0",
        grasps={name: recordings.GraspInfo(np.array([corner]), RADIUS) for name, corner in CORNER.items()},
        joints={name: _motion(plan, t, q[name], result, name, measured) for name in SIDE},
        robots={name: recordings.RobotInfo("rizon4", rig[name].base.numpy(), "tcp_closed") for name in SIDE},
        cameras={"cam0": _camera(plan)},
        points=points,
        truth=truth,
        observation_noise_std=round(sigma, 5),
        gravity=np.array([0.0, 0.0, plan.sheet.gravity]),
        air_density=plan.sheet.air_density,
        split={"motion": "bimanual_swing", "replicate_of": None},
    )
    return recording, facts


def upper_edge_strain(sheet: SheetSpec, x: Array) -> tuple[float, float]:
    """Smallest and largest relative change of the upper edge's length over the frames [T, V, 3]."""
    edge = x.reshape(len(x), sheet.nodes[1], sheet.nodes[0], 3)[:, -1]
    strain = np.linalg.norm(np.diff(edge, axis=1), axis=-1).sum(1) / sheet.width - 1
    return float(strain.min()), float(strain.max())


def _cloth(plan: Plan, uv: Array, faces: Array, first: Array) -> recordings.ClothInfo:
    sheet = plan.sheet
    return recordings.ClothInfo(
        areal_density=sheet.areal_density,
        areal_density_std=0.005,
        thickness=1e-3,
        initial_vertices=first,
        vertices=np.column_stack([uv, np.zeros(len(uv))]),
        faces=faces,
        uv=uv,
        nominal=dict(NOMINAL),
    )


def _camera(plan: Plan) -> recordings.Camera:
    camera = plan.place.camera()
    return recordings.Camera(width=camera.width, height=camera.height, K=camera.K, T_world_camera=camera.T_world_camera)


def _parameters(plan: Plan) -> dict[str, Array]:
    """The true parameters, for scoring: they go into truth.npz, which no fit reads."""
    sheet = plan.sheet
    return {
        "membrane_stiffness": np.float64(sheet.membrane_stiffness),
        "poisson_ratio": np.float64(sheet.poisson_ratio),
        "bending_stiffness": np.float64(sheet.bending_stiffness),
        "damping_time": np.float64(sheet.damping_time),
        "drag_normal": np.float64(sheet.drag_normal),
        "areal_density": np.float64(sheet.areal_density),
    }


def _motion(
    plan: Plan, t: Array, q: Array, result: Result, name: str, rng: np.random.Generator
) -> recordings.JointMotion:
    noise = rng.standard_normal((2, len(t), 3))
    return recordings.JointMotion(
        t,
        q,
        closed=np.ones(len(t), bool),
        width=np.zeros(len(t)),
        force=(result.force[name] + plan.force_noise * noise[0]).round(4),
        torque=(result.torque[name] + plan.torque_noise * noise[1]).round(5),
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "torchcloth" / "examples" / "bimanual_swing")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--fit-nodes", type=int, default=17, help="vertices along each side of cloth.obj")
    parser.add_argument("--overwrite", action="store_true")
    args = parser.parse_args()
    recording, facts = make(Plan(seed=args.seed, fit_nodes=args.fit_nodes))
    folder = recordings.write(recording, args.out, overwrite=args.overwrite)
    size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    print(f"{folder}: {size / 1e6:.2f} MB")
    for key, value in facts.items():
        print(f"  {key}: {np.round(value, 5)}")


if __name__ == "__main__":
    main()
