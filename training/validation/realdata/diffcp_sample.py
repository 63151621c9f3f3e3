"""Adapter: the measured sample that the DiffCP paper's authors released, as a torchcloth recording.

    P=torchcloth.training.validation.realdata
    python -m $P.diffcp_sample OUT_EPISODE [--source DIR] [--clouds N] [--seconds-per-step S]
    torchcloth identify OUT_EPISODE --out DIR --fit youngs_modulus --iterations 3

The files hold a dress lying on a table (427 vertices, 777 triangles, inflated to 0.12 m), two grippers that lift
its long side and carry it towards a rigid cube (1942 steps, positions in whole millimetres), 8 clouds of 31 points.
"Code" below is github denzelzheng/diffcp, src/parameter_fitting (commit c5a977b9). Everything else is assumed, and
marked so.

Units and axes
- Metres; y up becomes z up by a quarter turn about x: (x, y, z) -> (x, -z, y). The code's scaling by 0.5 is left out.

Time
- Code: a trajectory step lasts 0.03 s and cloud k belongs to step 100 (k + 1). The recorded clock itself is unknown.
- Changed: a step lasts SECONDS_PER_STEP, 30 times less than in the code: one simulation of 800 steps would take minutes
  otherwise. The smoothed paths then run at 0.5 m/s on average. `--seconds-per-step 0.03` gives the code's time base.
  The Chamfer distance at the start values hardly depends on it (21 to 24 mm at 1, 2 and 4 ms).
- Unchanged, though doubtful: with the simulated cloth, clouds 4 to 7 fit best 150 steps later than the code says.
- Changed: cloud 0 is placed at time 0. The shape must be known at a recording's first frame, and it is known at step 0
  only. Until step 100 the grippers rise 14 mm. The fit does not use the first frame's residuals.
- The path ends at the last cloud (step 800). The cloth has not reached the cube by then; the cube is left out.
- Changed: positions are averaged over SMOOTHING_STEPS, since jumps of 1 mm in 1 ms would shake the cloth. The path is
  sampled every STEPS_PER_KNOT steps.

Cloth
- Code: the garment weighs 0.5 kg; over the mesh's area that is 0.67 kg/m^2. No scales are mentioned; the mass is
  assumed to be right.
- Assumed: thickness 0.5 mm (only E h matters without contact); Poisson's ratio 0.2; E h = 300 N/m to start from,
  torchcloth's own default. The paper reads 609 N/m for cotton.
- Assumed: bending stiffness 5e-5 N m, with the large damping time 0.2 s. Without bending the slack layers wrinkle
  chaotically: a change of E by 0.01 % moves vertices by 30 mm (rms), and no gradient means anything.
- Changed: a recording has one pattern coordinate per vertex, which a sewn dress cannot have. It is cut open along the
  side without grippers and along both shoulders, and flattened. Cut seams are not sewn together. The side with the
  grippers stays whole. Two parts are dropped: a closed pocket of four triangles that hangs on one edge, and one
  triangle next to it that folds over in the plane. The rest shape is the pattern: 90 % of its stretches lie within 8 %
  of the file's mesh.
- Changed: the file's thinnest triangles (2.4 mm) would cost 4 times the substeps; vertices are merged until no triangle
  is thinner than MIN_TRIANGLE_HEIGHT_M. 369 of 427 vertices (with the doubled ones) and 636 of 777 triangles remain.
- Changed: at the start no vertex is below the table. Layers do not collide with each other (no self-contact).

Grippers and table
- Assumed: identity orientation, closed throughout. Each holds the vertex nearest to it at step 0 (17 and 20 mm away):
  one vertex is a ball joint, so the missing orientation does not matter.
- Assumed: table top at 0.02 m, the lowest points of every cloud; friction 0.4. Air 1.2 kg/m^3. The sensor noise is
  unknown.

Some points of clouds 2 and 3 lie on the cube, not on the cloth (x < 0.65 m). They are not removed.

The sample shows that the pipeline runs on measured data. E h between 10 and 1500 N/m changes the Chamfer distance of
23 mm by a few mm, irregularly: these 248 points do not determine E.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh

from torchcloth import recordings
from torchcloth.recordings import ClothInfo, Collider, GraspInfo, GripperMotion, PointClouds, Recording

from .flattening import (
    Edge,
    collapse_slivers,
    cut_mesh,
    find_boundary_loops,
    find_shortest_path,
    flatten,
    map_edges_to_faces,
    signed_areas,
    triangle_heights,
)
from .source_folders import source_folder

SECONDS_PER_STEP = 0.001
STEPS_PER_CLOUD = 100
MIN_TRIANGLE_HEIGHT_M = 0.010
SMOOTHING_STEPS, STEPS_PER_KNOT = 11, 5
GARMENT_MASS_KG = 0.5
TABLE_HEIGHT_M = 0.02
GARMENT_THICKNESS_M = 5e-4
GARMENT_NOMINAL_VALUES = {
    "membrane_stiffness": 300.0,
    "poisson_ratio": 0.2,
    "bending_stiffness": 5e-5,
    "bending_damping_time": 0.2,
    "units": {
        "membrane_stiffness": "N/m",
        "poisson_ratio": "-",
        "bending_stiffness": "N m",
        "bending_damping_time": "s",
    },
}
SINGLE_VERTEX_RADIUS_M = 0.005  # a grasp of this radius holds one vertex: its neighbours are further away


class Garment(NamedTuple):
    """The garment's mesh after cutting.

    Attributes:
        vertices: [V, 3] m, as in the file, z up.
        faces: [F, 3].
        uv: [V, 2] m, pattern.
        notes: numbers of vertices and triangles before and after.
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    notes: dict[str, float]


def to_z_up(points: np.ndarray) -> np.ndarray:
    """Convert points [..., 3] with y up to z up: (x, -z, y)."""
    return np.stack([points[..., 0], -points[..., 2], points[..., 1]], axis=-1)


def read_garment(path: Path) -> Garment:
    """Read the garment's mesh, cut it open and flatten it."""
    mesh: Any = trimesh.load_mesh(path, process=False, maintain_order=True)
    vertices, faces = to_z_up(np.asarray(mesh.vertices, dtype=float)), np.asarray(mesh.faces, dtype=np.int64)
    non_manifold = [edge for edge, owners in map_edges_to_faces(faces).items() if len(owners) > 2]
    opened, source = cut_mesh(faces, [*_seams(vertices, faces), *non_manifold])
    flat = flatten(vertices[source], opened)
    unfolded = opened[signed_areas(flat.uv[opened]) > 0]
    merged, old = collapse_slivers(flat.uv, unfolded, MIN_TRIANGLE_HEIGHT_M)
    notes = {
        "vertices_in_file": len(vertices),
        "vertices_after_cutting": len(source),
        "triangles_in_file": len(faces),
        "triangles_dropped_pocket": len(faces) - len(opened),
        "triangles_dropped_folded": len(opened) - len(unfolded),
        "vertices_after_merging": len(old),
        "triangles_after_merging": len(merged),
        "thinnest_triangle_m": float(triangle_heights(flat.uv[old][merged]).min()),
        "flattening_stretch_5_percent": float(np.quantile(flat.stretch, 0.05)),
        "flattening_stretch_95_percent": float(np.quantile(flat.stretch, 0.95)),
        "area_in_file_m2": float(mesh.area),
        "area_of_pattern_m2": float(signed_areas(flat.uv[old][merged]).sum()),
    }
    return Garment(vertices[source[old]], merged, flat.uv[old], notes)


def _seams(vertices: np.ndarray, faces: np.ndarray) -> list[Edge]:
    """Return the edges of the seams: the far side from armhole to hem, and both shoulders from armhole to neck."""
    hem, neck, *arms = find_boundary_loops(faces)
    near, far = sorted(arms, key=lambda loop: vertices[loop, 0].mean())
    paths = ((far, hem), (far, neck), (near, neck))
    return [edge for start, end in paths for edge in find_shortest_path(vertices, faces, start, end)]


def smooth_path(path: np.ndarray) -> np.ndarray:
    """Return the moving average of a path [K, ...] over SMOOTHING_STEPS; the ends do not move."""
    padded = np.concatenate([path[:1].repeat(SMOOTHING_STEPS // 2, 0), path, path[-1:].repeat(SMOOTHING_STEPS // 2, 0)])
    return np.stack([padded[i : i + len(path)] for i in range(SMOOTHING_STEPS)]).mean(0)


def read_recording(source: Path, seconds_per_step: float = SECONDS_PER_STEP, count: int | None = None) -> Recording:
    """Convert the sample into a recording; see the module's docstring.

    Args:
        source: the source's folder.
        seconds_per_step: time base.
        count: of clouds, the first ones; None: all.
    """
    cloth = read_garment(source / "cloth_mesh.ply")
    clouds = to_z_up(np.load(source / "target_pcd_sample.npy"))[:count]
    steps = STEPS_PER_CLOUD * np.arange(1, len(clouds) + 1)
    path = to_z_up(np.load(source / "grasp_traj_array.npy"))[: steps[-1] + 1]
    knots = np.arange(0, len(path), STEPS_PER_KNOT)
    positions = smooth_path(path)[knots]
    start = cloth.vertices.copy()
    start[:, 2] = np.maximum(start[:, 2], TABLE_HEIGHT_M)
    nearest = np.linalg.norm(start[:, None] - path[0], axis=-1)
    grasped = nearest.argmin(0)
    names = [f"gripper{k}" for k in range(path.shape[1])]
    area = cloth.notes["area_of_pattern_m2"]
    return Recording(
        cloth=ClothInfo(
            areal_density=GARMENT_MASS_KG / area,
            thickness=GARMENT_THICKNESS_M,
            vertices=cloth.vertices,
            faces=cloth.faces,
            uv=cloth.uv,
            initial_vertices=start,
            nominal=GARMENT_NOMINAL_VALUES,
        ),
        grasps={
            name: GraspInfo(cloth.uv[[vertex]], SINGLE_VERTEX_RADIUS_M)
            for name, vertex in zip(names, grasped, strict=True)
        },
        grippers={
            name: GripperMotion(
                t=seconds_per_step * knots,
                position=positions[:, k],
                quat_wxyz=np.tile([1.0, 0.0, 0.0, 0.0], (len(knots), 1)),
                closed=np.ones(len(knots), dtype=bool),
            )
            for k, name in enumerate(names)
        },
        colliders={"table": Collider(np.array([0.0, 0.0, TABLE_HEIGHT_M]), np.array([0.0, 0.0, 1.0]), 0.4)},
        points=PointClouds(
            t=seconds_per_step * np.concatenate([[0], steps[1:]]),
            xyz=clouds.reshape(-1, 3),
            counts=np.full(len(clouds), clouds.shape[1]),
        ),
        air_density=1.2,
        provenance="measured",
        licence="none stated by its authors (github denzelzheng/diffcp): for tests here, not to be passed on",
        extra={
            "notes": {
                "source": "github denzelzheng/diffcp, data/",
                "units": "m, s, kg; y up in the files, z up here",
                "seconds_per_step": {
                    "used": seconds_per_step,
                    "in the released code": 0.03,
                    "in reality": "unknown",
                },
                "first cloud": "step 100, placed at step 0, where the shape is known",
                "gripper path": (
                    f"mean over {SMOOTHING_STEPS} steps, sampled every {STEPS_PER_KNOT}th; orientation not recorded,"
                    " set to identity"
                ),
                "areal density": "0.5 kg in the released code over the mesh's area",
                "assumed": "thickness, Poisson's ratio, start stiffness, bending, table height, friction, air density",
                "grasped vertices": {n: int(v) for n, v in zip(names, grasped, strict=True)},
                "distance of grasped vertex and gripper (m)": {
                    n: float(d) for n, d in zip(names, nearest.min(0), strict=True)
                },
                "left out": "rigid cube (not reached), self-contact; cut seams are not sewn",
                "mesh": cloth.notes,
            }
        },
    )


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="The released DiffCP sample as a torchcloth recording.")
    parser.add_argument("episode", type=Path, metavar="OUT_EPISODE", help="folder to write")
    parser.add_argument("--source", type=Path, help="default: $TORCHCLOTH_REALDATA/diffcp_sample")
    parser.add_argument("--seconds-per-step", type=float, default=SECONDS_PER_STEP)
    parser.add_argument("--clouds", type=int, metavar="N", help="only the first N clouds")
    options = parser.parse_args()
    source = source_folder(parser, options.source, "diffcp_sample")
    recording = read_recording(source, options.seconds_per_step, options.clouds)
    recordings.write(recording, options.episode)
    mesh, points = recording.extra["notes"]["mesh"], recording.require("points")
    size = f"{mesh['vertices_after_merging']} vertices, {mesh['triangles_after_merging']} triangles"
    print(f"{options.episode}: {size}, {len(points)} clouds, {points.t[-1]:.3g} s")


if __name__ == "__main__":
    main()
