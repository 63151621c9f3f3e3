"""Adapter: 9 carries of the IRI cloth (github Alados5/mpc_node, 2021) along three-dimensional paths, 18 to 31 s each.

    python -m torchcloth.training.validation.realdata.carries OUT_EPISODE --run NAME [--source DIR]

The rig is that of the swings: a square cloth of side 0.30 m, held along its upper edge by a rigid hanger below the tool
of a Barrett WAM with 7 joints. `read_runs` gives the fields that the swings have, so that the functions of `swings` and
`frame_times` take both: the nodes in the robot's base frame, with the second grid index from bottom to top.

Motion: the tool's recorded pose. `load_arm` gives the arm; its forward kinematics with the recorded joints is that pose
(`measure_kinematics`).

Clock: a frame was taken about 0.2 s before the stamp of the frame before it (see `frame_times`). Points have these
times, a frame's first guess without its jitter. The first frame has none and is left out.

Unknown are fabric, mass, thickness and stiffness, as for the swings. The camera's pose is from a calibration of the
same day; nodes before the motion differ from the vertical by up to 12 mm, by a different amount in each run.
"""

from __future__ import annotations

import argparse
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torchcloth import recordings
from torchcloth._utils.constants import STANDARD_AIR_DENSITY_KG_PER_M3
from torchcloth.recordings import GraspInfo, GripperMotion, Markers, PointClouds, Recording
from torchcloth.robots import Arm, load  # pyright: ignore[reportMissingImports]

from . import frame_times, swings
from .source_folders import source_folder
from .swings import SHEET_SIDE_M, Run

SOURCE_NAME = "wam_carries"
ARM_FILE = Path(__file__).with_name("wam7.urdf")
TOOL_LINK = "tool"
MAX_STAMP_DIFFERENCE_S = 1e-3  # of joints and a tool's pose that belong together


class KinematicsError(NamedTuple):
    """Differences between the arm's forward kinematics and the recorded pose of the tool.

    Attributes:
        rms_m: of the position.
        largest_m: of the position.
        rms_deg: of the rotation.
        largest_deg: of the rotation.
        count: of compared samples.
    """

    rms_m: float
    largest_m: float
    rms_deg: float
    largest_deg: float
    count: int


@lru_cache(1)
def read_runs(path: Path) -> dict[str, Run]:
    """Read the fields of every run by its name: those of the swings, and the joints (``t_joint_s``, ``joint_rad``)."""
    from scipy.spatial.transform import Rotation

    runs = {}
    with np.load(path / "carries.npz") as file:
        for name in sorted({key.split("/")[0] for key in file.files}):
            pose = file[f"{name}/camera_pose_pos_quat_xyzw"]
            nodes = file[f"{name}/mesh_camera_m"].astype(float)
            world = Rotation.from_quat(pose[3:]).apply(nodes.reshape(-1, 3)) + pose[:3]
            runs[name] = {
                "t_mesh_s": file[f"{name}/t_mesh_s"].astype(float),
                "mesh_base_m": world.reshape(nodes.shape)[:, :, ::-1],
                "t_tcp_s": file[f"{name}/t_tool_s"].astype(float),
                "tcp_pos_m": file[f"{name}/tool_pos_m"].astype(float),
                "tcp_quat_xyzw": file[f"{name}/tool_quat_xyzw"].astype(float),
                "t_joint_s": file[f"{name}/t_joint_s"].astype(float),
                "joint_rad": file[f"{name}/joint_position"].astype(float),
            }
    return runs


def load_arm() -> Arm:
    """Load the arm of the rig, a Barrett WAM with 7 joints, from a URDF file of its Denavit-Hartenberg parameters."""
    return load(ARM_FILE, frame=TOOL_LINK)


def measure_kinematics(run: Run) -> KinematicsError:
    """Compare the arm's forward kinematics with the recorded pose, where both have the same stamp within 1 ms."""
    import torch
    from scipy.spatial.transform import Rotation

    nearest = np.abs(run["t_joint_s"][:, None] - run["t_tcp_s"]).argmin(1)
    together = np.abs(run["t_joint_s"] - run["t_tcp_s"][nearest]) < MAX_STAMP_DIFFERENCE_S
    pose = load_arm()(torch.as_tensor(run["joint_rad"][together])).numpy()
    tool = nearest[together]
    distance = np.linalg.norm(pose[:, :3, 3] - run["tcp_pos_m"][tool], axis=1)
    turn = Rotation.from_matrix(pose[:, :3, :3]).inv() * Rotation.from_quat(run["tcp_quat_xyzw"][tool])
    angle = np.degrees(turn.magnitude())
    rms = [float(np.sqrt((part**2).mean())) for part in (distance, angle)]
    return KinematicsError(rms[0], float(distance.max()), rms[1], float(angle.max()), len(distance))


def read_episode(path: Path, run: str) -> Recording:
    """Read one run as a recording; see the module's docstring.

    Args:
        path: the source's folder.
        run: a key of `read_runs`.
    """
    data = read_runs(Path(path))[run]
    (t, position, quat), is_accepted = swings.tool_motion(data), swings.accepted_frames(data)
    clock = frame_times.estimate_clock(data)
    stamps, mesh = frame_times.image_stamps(data), data["mesh_base_m"].reshape(len(data["t_mesh_s"]), -1, 3)
    has_depth = np.asarray(np.isfinite(mesh).all(-1))
    use = is_accepted & (stamps - clock.lag >= t[0]) & (stamps - clock.lag <= t[-1])
    edge = np.linspace(0, SHEET_SIDE_M, 31)
    frames = {"all": len(stamps), "rejected by arc length": int((~is_accepted).sum()), "in points": int(use.sum())}
    return Recording(
        cloth=swings.describe_cloth(data),
        grasps={"hanger": GraspInfo(np.stack([edge, np.full(31, SHEET_SIDE_M)], -1), 0.006)},
        grippers={"hanger": GripperMotion(t, position, quat, np.ones(len(t), dtype=bool))},
        points=PointClouds(stamps[use], mesh[use][has_depth[use]], has_depth[use].sum(1)),
        markers=Markers(
            stamps[1:], mesh[1:], extra={"accepted": is_accepted[1:], "grid": np.array(data["mesh_base_m"].shape[1:3])}
        ),
        observation_noise_std=float(swings.estimate_noise(data)[1]),
        clock_offset=-clock.lag,
        air_density=STANDARD_AIR_DENSITY_KG_PER_M3,
        provenance="measured",
        licence="none stated by its authors (github Alados5/mpc_node): for tests here, not to be passed on",
        extra={"notes": {"run": run, "frames": frames, **_notes(clock)}},
    )


def _notes(clock: frame_times.Clock) -> dict[str, Any]:
    return {
        "source": "github Alados5/mpc_node, IRI (CSIC-UPC) July 2021",
        "lag behind the stamp of the frame before (s)": clock.lag,
        "jitter of single frames (s, standard deviation)": clock.jitter_std,
        "upper edge from tool, in the tool's axes (m)": clock.edge_offset.tolist(),
        "assumed": "areal density, bending and its damping, air density, the whole upper edge is held",
        "not known": "fabric, mass, thickness, stiffness",
    }


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="One IRI carry as a torchcloth recording.")
    parser.add_argument("episode", type=Path, metavar="OUT_EPISODE", help="folder to write")
    parser.add_argument("--run", required=True, help="a name in the source's index.csv")
    parser.add_argument("--source", type=Path, help=f"default: $TORCHCLOTH_REALDATA/{SOURCE_NAME}")
    options = parser.parse_args()
    recording = read_episode(source_folder(parser, options.source, SOURCE_NAME), options.run)
    recordings.write(recording, options.episode)
    print(f"{options.episode}: {recording.extra['notes']['frames']}")


if __name__ == "__main__":
    main()
