"""Adapter: cloths lifted by one corner and seen by a depth camera (github priyasundaresan/diffcloud_real2sim), 7 lifts.

    P=torchcloth.training.validation.realdata
    python -m $P.lifts OUT_EPISODE --trial lift_paper --spacing 0.01 [--everything] [--source DIR]
    torchcloth identify OUT_EPISODE --out DIR --fit youngs_modulus --iterations 1

Clouds: 25 frames at 10 Hz. `crop=True` selects the points of the cloth: above the crop height (the table lies below),
not too far above the gripper (its housing is there), and in a large connected component of occupied voxels. Frames with
too few such points are dropped: the cloth still lies below the crop, and the visible points are the gripper's. The
first frame is always recorded: it says where the simulation begins, and a fit does not use its residuals. `crop=False`
records every point; `points.extra["cloth"]` says which ones are cloth.

Gripper: the commanded path, rotated and shifted to where the clouds show the corner. The highest points of all 7 lifts
agree on this registration within 0.4 degrees and 3 mm, so it is an error of the camera's pose, not of a lift. After it
they lie 3 mm from the path sideways and 8 mm in height. The command is in `extra["commanded"]`.

Cloth: a square that is held by one corner. Its side is measured over the surface from the grip to the two neighbouring
corners, where these hang above the crop (`measure_sides`). Navy and polka are folded, so their side is only bounded
from below; it is assumed to be the same. At the first frame the cloth is assumed to lie flat on the table, with its
diagonal along the path. (The tan one is rumpled.)

Unknown are the fabrics, the masses, the lag between camera and robot, and the rotation of the gripper. No parameter is
identifiable.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from torchcloth import observe, recordings
from torchcloth._utils.constants import STANDARD_AIR_DENSITY_KG_PER_M3
from torchcloth.recordings import ClothInfo, Collider, GraspInfo, GripperMotion, PointClouds, Recording

from .source_folders import source_folder

FRAME_RATE_HZ = 10.0
CROP_HEIGHT_M = 0.075  # z, by the authors of the data
MAX_RISE_ABOVE_GRIPPER_M = 0.04
VOXEL_SIZE_M = 0.01
MIN_COMPONENT_FRACTION = 0.03  # of the frame's points
MIN_CLOTH_POINTS = 1000  # of a frame
CAMERA_YAW_RAD = np.radians(-9.0)
CAMERA_SHIFT_M = np.array([0.023, -0.029, -0.001])  # of the path's first point
LIFTED_SIDE_M, LIFTED_SIDE_STD_M = 0.27, 0.02  # of `measure_sides`: std 0.008, and paths over points are never straight
UNFOLDED_TRIALS = ("lift_tan", "lift_paper", "lift_paper2")  # their side corners are visible
LIFTED_DENSITY_KG_PER_M2, LIFTED_DENSITY_STD_KG_PER_M2 = 0.15, 0.10  # assumed: light clothing
LIFTED_BENDING_N_M, LIFTED_DAMPING_TIME_S = 2e-5, 0.02  # assumed


def list_trials(path: Path) -> list[str]:
    """Return the names of the lifts."""
    with np.load(path / "lifts.npz") as file:
        return [key.removesuffix("_counts") for key in file.files if key.endswith("_counts")]


def read_clouds(path: Path, trial: str) -> list[np.ndarray]:
    """Read the 25 clouds [N, 3] m of a lift, as stored."""
    with np.load(path / "lifts.npz") as file:
        xyz, counts = 1e-4 * file[f"{trial}_xyz_0p1mm"], file[f"{trial}_counts"]
    return np.split(xyz, np.cumsum(counts)[:-1])


def read_command(path: Path) -> np.ndarray:
    """Read the gripper's commanded path [25, 3] m, the same for all lifts."""
    with np.load(path / "waypoints.npz") as file:
        return file["lift"]


def read_labelled_clouds(path: Path, trial: str) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Read the clouds, and for each which of its points are cloth."""
    raw = read_clouds(path, trial)
    return raw, [
        is_cloth(c, top) for c, top in zip(raw, read_command(path)[:, 2] + MAX_RISE_ABOVE_GRIPPER_M, strict=True)
    ]


def connected_components(cloud: np.ndarray, cell: float = VOXEL_SIZE_M) -> np.ndarray:
    """Return the component [N] of each point: voxels of ``cell`` m that touch, also at a corner, are connected."""
    from scipy.ndimage import label

    place = np.floor((cloud - cloud.min(0)) / cell).astype(int)
    occupied = np.zeros(place.max(0) + 1, dtype=bool)
    occupied[tuple(place.T)] = True
    components, _ = label(occupied, np.ones((3, 3, 3)))  # type: ignore[misc]
    return components[tuple(place.T)]


def is_cloth(cloud: np.ndarray, top: float) -> np.ndarray:
    """Return which points [N] lie between the crop and ``top`` [m] in a large component.

    It is none of them where the cloth is not yet above the crop.
    """
    inside = (cloud[:, 2] > CROP_HEIGHT_M) & (cloud[:, 2] < top)
    if inside.sum() < MIN_CLOTH_POINTS:
        return np.zeros(len(cloud), dtype=bool)
    component = connected_components(cloud[inside])
    large = np.bincount(component) >= MIN_COMPONENT_FRACTION * inside.sum()
    inside[inside] = large[component]
    return inside


def rotate_about_z(path: np.ndarray, yaw: float) -> np.ndarray:
    """Rotate vectors [K, 3] about z by ``yaw`` [rad]."""
    c, s = np.cos(yaw), np.sin(yaw)
    return path @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def to_cloud_frame(commanded: np.ndarray) -> np.ndarray:
    """Return a commanded path [K, 3] m in the clouds' frame."""
    return commanded[0] + CAMERA_SHIFT_M + rotate_about_z(commanded - commanded[0], CAMERA_YAW_RAD)


def fit_registration(path: Path, trial: str, first: int = 9) -> tuple[float, np.ndarray, np.ndarray]:
    """Fit the registration of the commanded path to the highest points of the cloth.

    The highest points are the mean of the cloth's uppermost 10 mm in the frames from ``first`` on.

    Returns:
        Yaw [rad], shift [3] m of the path's start, and RMS of the residuals [3] m.
    """
    raw, cloth = read_labelled_clouds(path, trial)
    top = [c[f] for c, f in zip(raw, cloth, strict=True)][first:]
    highest = np.stack([c[c[:, 2] > c[:, 2].max() - 0.01].mean(0) for c in top])
    commanded = read_command(path)
    a, b = commanded[first:] - commanded[first:].mean(0), highest - highest.mean(0)
    yaw = float(np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a[:, :2] * b[:, :2]).sum()))
    shift = highest.mean(0) + rotate_about_z(commanded[0] - commanded[first:].mean(0), yaw) - commanded[0]
    return yaw, shift, np.sqrt(((b - rotate_about_z(a, yaw)) ** 2).mean(0))


def measure_sides(path: Path, trial: str, link: float = 0.02) -> np.ndarray:
    """Measure the two sides [2] m of the cloth that meet at the grip.

    A side is the shortest path over the last cloud from its top to its leftmost or rightmost point, less the rise of
    the top above the gripper, which is pinched cloth or finger. Steps of up to ``link`` [m] cut few corners and zigzag
    little.
    """
    from scipy.sparse.csgraph import dijkstra
    from scipy.spatial import KDTree

    raw, cloth = read_labelled_clouds(path, trial)
    cloud = raw[-1][cloth[-1]][::2]
    tree = KDTree(cloud)
    distance = dijkstra(tree.sparse_distance_matrix(tree, link).tocsr(), indices=cloud[:, 2].argmax())
    rise = cloud[:, 2].max() - to_cloud_frame(read_command(path))[-1, 2]
    return distance[[cloud[:, 1].argmin(), cloud[:, 1].argmax()]] - rise


def flat_square(corner: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Return the corners [2, 2, 3] m of a flat square with a corner at ``corner`` and its diagonal along ``ahead``."""
    angle = np.arctan2(ahead[1], ahead[0])
    u, v = (LIFTED_SIDE_M * np.array([np.cos(angle + t), np.sin(angle + t), 0.0]) for t in (-np.pi / 4, np.pi / 4))
    return np.stack([[corner, corner + v], [corner + u, corner + u + v]])


def read_episode(path: Path, trial: str, crop: bool = True, spacing: float | None = None) -> Recording:
    """Read one lift, e.g. "lift_paper", as a recording; see the module's docstring.

    Args:
        path: the source's folder.
        trial: one of `list_trials`.
        crop: record only cloth; otherwise every point, with a flag.
        spacing: m, thin the cropped clouds to one measured point in a voxel of this size, which is enough for fits.
    """
    path = Path(path)
    raw, cloth = read_labelled_clouds(path, trial)
    commanded = read_command(path)
    gripper = to_cloud_frame(commanded)
    t = np.arange(len(raw)) / FRAME_RATE_HZ
    used = [i for i in range(len(raw)) if not crop or i == 0 or cloth[i].any()]
    recorded = [c[f] if crop and f.any() else c for c, f in zip(raw, cloth, strict=True)]
    if crop and spacing is not None:
        recorded = [observe.thin_to_spacing(c, spacing) for c in recorded]
    flags = {} if crop else {"cloth": np.concatenate(cloth)}
    no_rotation = np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1))
    closed = np.ones(len(t), dtype=bool)
    return Recording(
        cloth=_cloth_info(gripper),
        grasps={"gripper": GraspInfo(np.zeros((1, 2)), 0.015)},
        grippers={"gripper": GripperMotion(t, gripper, no_rotation, closed, extra={"commanded": commanded})},
        colliders={"table": Collider(np.array([0.0, 0.0, gripper[0, 2]]), np.array([0.0, 0.0, 1.0]), 0.4)},
        points=PointClouds(
            t[used],
            np.concatenate([recorded[i] for i in used]),
            np.array([len(recorded[i]) for i in used]),
            extra=flags,
        ),
        air_density=STANDARD_AIR_DENSITY_KG_PER_M3,
        split={"motion": "lift"},
        provenance="measured",
        licence="none stated by its authors (github priyasundaresan/diffcloud_real2sim): for tests here, not to ship",
        extra={"notes": {"trial": trial, "cropped": crop, **_notes(raw, cloth, trial)}},
    )


def _cloth_info(gripper: np.ndarray) -> ClothInfo:
    return ClothInfo(
        areal_density=LIFTED_DENSITY_KG_PER_M2,
        areal_density_std=LIFTED_DENSITY_STD_KG_PER_M2,
        sheet=(LIFTED_SIDE_M, LIFTED_SIDE_M),
        initial_vertices=flat_square(gripper[0], (gripper[-1] - gripper[0])[:2]),
        nominal={
            "bending_stiffness": LIFTED_BENDING_N_M,
            "bending_damping_time": LIFTED_DAMPING_TIME_S,
            "units": {"bending_stiffness": "N m", "bending_damping_time": "s"},
        },
    )


def _notes(raw: list[np.ndarray], cloth: list[np.ndarray], trial: str) -> dict[str, Any]:
    below = [int((c[:, 2] <= CROP_HEIGHT_M).sum()) for c in raw]
    with_cloth = [i for i in range(len(raw)) if cloth[i].any()]
    return {
        "source": "github priyasundaresan/diffcloud_real2sim",
        "points": {
            "all": sum(map(len, raw)),
            "below the crop": sum(below),
            "outliers, in frames that show the cloth": int(
                sum(len(raw[i]) - below[i] - cloth[i].sum() for i in with_cloth)
            ),
        },
        "frames that show no cloth above the crop": [i for i in range(len(raw)) if i not in with_cloth],
        "gripper": (
            f"command rotated by {np.degrees(CAMERA_YAW_RAD):.1f} degrees and shifted by {CAMERA_SHIFT_M.tolist()} m,"
            " to the clouds"
        ),
        "side (m)": {"value": LIFTED_SIDE_M, "std": LIFTED_SIDE_STD_M, "measured": trial in UNFOLDED_TRIALS},
        "assumed": "areal density, bending, flat start, table at the gripper's first height and its friction",
        "not known": "fabric, mass, lag, gripper's rotation; no parameter is identifiable",
    }


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="One lift as a torchcloth recording.")
    parser.add_argument("episode", type=Path, metavar="OUT_EPISODE", help="folder to write")
    parser.add_argument("--trial", default="lift_paper")
    parser.add_argument("--everything", action="store_true", help="record every point, with a flag")
    parser.add_argument(
        "--spacing", type=float, metavar="M", help="thin to one point in a voxel of this size, e.g. 0.01"
    )
    parser.add_argument("--source", type=Path, help="default: $TORCHCLOTH_REALDATA/lifted_cloth_clouds")
    options = parser.parse_args()
    source = source_folder(parser, options.source, "lifted_cloth_clouds")
    recording = read_episode(source, options.trial, not options.everything, options.spacing)
    recordings.write(recording, options.episode)
    print(f"{options.episode}: {len(recording.require('points'))} frames, {recording.extra['notes']['points']}")


if __name__ == "__main__":
    main()
