"""Adapter: cloths lifted by one corner and seen by a depth camera (github priyasundaresan/diffcloud_real2sim), 7 lifts.

    python -m torchcloth.training.validation.realdata.lifts OUT_EPISODE --trial lift_paper --spacing 0.01 [--everything] [--source DIR]
    torchcloth identify OUT_EPISODE --out DIR --fit youngs_modulus --iterations 1

Clouds: 25 frames at 10 Hz. `crop=True` keeps what is cloth: above CROP (the table lies below it), at most RISE above
the gripper (higher up is its housing), and no outlier, that is in a piece of at least SMALLEST_PIECE of its frame's
points (occupied cubes of edge CELL that touch); frames in which less than WHOLE points are left are dropped, since the
cloth still lies below the crop there and what is seen is the gripper.
The first frame is kept whatever it shows: it says where the simulation begins, and a fit does not use its residuals.
`crop=False` keeps every point; `points.extra["cloth"]` says which ones are cloth.
Gripper: the commanded path, moved to where the clouds see the corner: turned by YAW and shifted by SHIFT. The highest
points of all 7 lifts agree on it within 0.4 degrees and 3 mm, so it is an error of the camera's pose, not of a lift;
after it they lie 3 mm from the path sideways and 8 mm in height. The command is kept as `extra["commanded"]`.
Cloth: a square held by one corner. Its side is measured over the surface from the grip to the two corners beside it,
where these hang above the crop: see `sides`. Navy and polka fold, theirs is only bounded from below: same side assumed.
At the first frame it is assumed to lie flat on the table, its diagonal along the path. (The tan one is rumpled.)
Not known: fabrics, masses, which lag camera and robot have; the rotation of the gripper. No parameter is identifiable.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from torchcloth import observe, recordings
from torchcloth.recordings import ClothInfo, Collider, GraspInfo, GripperMotion, PointClouds, Recording

from .source_folders import source_folder

RATE = 10.0  # Hz
CROP = 0.075  # m, z; the authors'
RISE = 0.04  # m
CELL = 0.01  # m
SMALLEST_PIECE = 0.03
WHOLE = 1000
YAW = np.radians(-9.0)
SHIFT = np.array([0.023, -0.029, -0.001])  # m, of the path's first point
SIDE, SIDE_STD = 0.27, 0.02  # m, mean and error of `sides`: spread 0.008, and ways over points are never straight
SPREAD = ("lift_tan", "lift_paper", "lift_paper2")  # whose side corners are seen
DENSITY, DENSITY_STD = 0.15, 0.10  # kg/m^2, assumed: light clothing
BENDING, DAMPING = 2e-5, 0.02  # N m, s, assumed


def trials(path: Path) -> list[str]:
    """Names of the lifts."""
    with np.load(path / "lifts.npz") as file:
        return [key.removesuffix("_counts") for key in file.files if key.endswith("_counts")]


def clouds(path: Path, trial: str) -> list[np.ndarray]:
    """25 clouds [N, 3] m, as stored."""
    with np.load(path / "lifts.npz") as file:
        xyz, counts = 1e-4 * file[f"{trial}_xyz_0p1mm"], file[f"{trial}_counts"]
    return np.split(xyz, np.cumsum(counts)[:-1])


def command(path: Path) -> np.ndarray:
    """[25, 3] m, the gripper's commanded path, the same for all lifts."""
    with np.load(path / "waypoints.npz") as file:
        return file["lift"]


def marked(path: Path, trial: str) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The clouds, and which of their points are cloth."""
    raw = clouds(path, trial)
    return raw, [is_cloth(c, top) for c, top in zip(raw, command(path)[:, 2] + RISE, strict=True)]


def pieces(cloud: np.ndarray, cell: float = CELL) -> np.ndarray:
    """[N] numbers of the pieces: cubes of edge ``cell`` m that touch, also at a corner, are of one piece."""
    from scipy.ndimage import label

    place = np.floor((cloud - cloud.min(0)) / cell).astype(int)
    occupied = np.zeros(place.max(0) + 1, dtype=bool)
    occupied[tuple(place.T)] = True
    return label(occupied, np.ones((3, 3, 3)))[0][tuple(place.T)]


def is_cloth(cloud: np.ndarray, top: float) -> np.ndarray:
    """[N] bool: between the crop and ``top`` m, in a large piece; none where the cloth is not above the crop yet."""
    inside = (cloud[:, 2] > CROP) & (cloud[:, 2] < top)
    if inside.sum() < WHOLE:
        return np.zeros(len(cloud), dtype=bool)
    piece = pieces(cloud[inside])
    large = np.bincount(piece) >= SMALLEST_PIECE * inside.sum()
    inside[inside] = large[piece]
    return inside


def turned(path: np.ndarray, yaw: float) -> np.ndarray:
    """Vectors [K, 3], turned about z by ``yaw`` rad."""
    c, s = np.cos(yaw), np.sin(yaw)
    return path @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def registered(commanded: np.ndarray) -> np.ndarray:
    """The path [K, 3] m in the clouds' frame."""
    return commanded[0] + SHIFT + turned(commanded - commanded[0], YAW)


def register(path: Path, trial: str, first: int = 9) -> tuple[float, np.ndarray, np.ndarray]:
    """Yaw rad, shift [3] m of the path's start and RMS [3] m, with which the path best meets the highest points.

    The highest points are the mean of the cloth's uppermost 10 mm in the frames from ``first`` on.
    """
    raw, cloth = marked(path, trial)
    top = [c[f] for c, f in zip(raw, cloth, strict=True)][first:]
    seen = np.stack([c[c[:, 2] > c[:, 2].max() - 0.01].mean(0) for c in top])
    way = command(path)
    a, b = way[first:] - way[first:].mean(0), seen - seen.mean(0)
    yaw = float(np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a[:, :2] * b[:, :2]).sum()))
    shift = seen.mean(0) + turned(way[0] - way[first:].mean(0), yaw) - way[0]
    return yaw, shift, np.sqrt(((b - turned(a, yaw)) ** 2).mean(0))


def sides(path: Path, trial: str, link: float = 0.02) -> np.ndarray:
    """[2] m, shortest way over the last cloud from its top to its leftmost and rightmost points, less the top's rise.

    What rises above the gripper is pinched cloth or finger. Steps of up to ``link`` cut corners and zigzag little.
    """
    from scipy.sparse.csgraph import dijkstra
    from scipy.spatial import cKDTree

    raw, cloth = marked(path, trial)
    cloud = raw[-1][cloth[-1]][::2]
    tree = cKDTree(cloud)
    way = dijkstra(tree.sparse_distance_matrix(tree, link).tocsr(), indices=cloud[:, 2].argmax())
    rise = cloud[:, 2].max() - registered(command(path))[-1, 2]
    return way[[cloud[:, 1].argmin(), cloud[:, 1].argmax()]] - rise


def lying(corner: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Corners [2, 2, 3] m of the flat square that begins at ``corner``, its diagonal along ``ahead`` [2]."""
    angle = np.arctan2(ahead[1], ahead[0])
    u, v = (SIDE * np.array([np.cos(angle + t), np.sin(angle + t), 0.0]) for t in (-np.pi / 4, np.pi / 4))
    return np.stack([[corner, corner + v], [corner + u, corner + u + v]])


def episode(path: Path, trial: str, crop: bool = True, spacing: float | None = None) -> Recording:
    """One lift, e.g. "lift_paper"; see the module's docstring.

    Args:
        path: the source's folder.
        trial: one of `trials`.
        crop: keep only cloth; otherwise every point, flagged.
        spacing: m, thin the cropped clouds to one measured point in a cube of this edge; fits need no more.
    """
    path = Path(path)
    raw, cloth = marked(path, trial)
    commanded = command(path)
    gripper = registered(commanded)
    t = np.arange(len(raw)) / RATE
    used = [i for i in range(len(raw)) if not crop or i == 0 or cloth[i].any()]
    kept = [c[f] if crop and f.any() else c for c, f in zip(raw, cloth, strict=True)]
    if crop and spacing is not None:
        kept = [observe.thin_to_spacing(c, spacing) for c in kept]
    flags = {} if crop else {"cloth": np.concatenate(cloth)}
    still = np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1))
    closed = np.ones(len(t), dtype=bool)
    return Recording(
        cloth=_cloth(gripper),
        grasps={"gripper": GraspInfo(np.zeros((1, 2)), 0.015)},
        grippers={"gripper": GripperMotion(t, gripper, still, closed, extra={"commanded": commanded})},
        colliders={"table": Collider(np.array([0.0, 0.0, gripper[0, 2]]), np.array([0.0, 0.0, 1.0]), 0.4)},
        points=PointClouds(
            t[used], np.concatenate([kept[i] for i in used]), np.array([len(kept[i]) for i in used]), extra=flags
        ),
        air_density=1.204,
        split={"motion": "lift"},
        provenance="measured",
        licence="none stated by its authors (github priyasundaresan/diffcloud_real2sim): for tests here, not to ship",
        extra={"notes": {"trial": trial, "cropped": crop, **_notes(raw, cloth, trial)}},
    )


def _cloth(gripper: np.ndarray) -> ClothInfo:
    return ClothInfo(
        areal_density=DENSITY,
        areal_density_std=DENSITY_STD,
        sheet=(SIDE, SIDE),
        initial_vertices=lying(gripper[0], (gripper[-1] - gripper[0])[:2]),
        nominal={
            "bending_stiffness": BENDING,
            "bending_damping_time": DAMPING,
            "units": {"bending_stiffness": "N m", "bending_damping_time": "s"},
        },
    )


def _notes(raw: list[np.ndarray], cloth: list[np.ndarray], trial: str) -> dict[str, Any]:
    below = [int((c[:, 2] <= CROP).sum()) for c in raw]
    shown = [i for i in range(len(raw)) if cloth[i].any()]
    return {
        "source": "github priyasundaresan/diffcloud_real2sim",
        "points": {
            "all": sum(map(len, raw)),
            "below the crop": sum(below),
            "outliers, in frames that show the cloth": int(sum(len(raw[i]) - below[i] - cloth[i].sum() for i in shown)),
        },
        "frames that show no cloth above the crop": [i for i in range(len(raw)) if i not in shown],
        "gripper": f"command turned by {np.degrees(YAW):.1f} degrees and shifted by {SHIFT.tolist()} m, to the clouds",
        "side (m)": {"value": SIDE, "std": SIDE_STD, "own": trial in SPREAD},
        "assumed": "areal density, bending, flat start, table at the gripper's first height and its friction",
        "not known": "fabric, mass, lag, gripper's rotation; no parameter is identifiable",
    }


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="One lift as a torchcloth recording.")
    parser.add_argument("episode", type=Path, metavar="OUT_EPISODE", help="folder to write")
    parser.add_argument("--trial", default="lift_paper")
    parser.add_argument("--everything", action="store_true", help="keep every point, flagged")
    parser.add_argument(
        "--spacing", type=float, metavar="M", help="thin to one point in a cube of this edge, e.g. 0.01"
    )
    parser.add_argument("--source", type=Path, help="default: $TORCHCLOTH_REALDATA/lifted_cloth_clouds")
    options = parser.parse_args()
    source = source_folder(parser, options.source, "lifted_cloth_clouds")
    recording = episode(source, options.trial, not options.everything, options.spacing)
    recordings.write(recording, options.episode)
    print(f"{options.episode}: {len(recording.points)} frames, {recording.extra['notes']['points']}")


if __name__ == "__main__":
    main()
