"""Recordings without truth as training data: their clouds teach by the simulation of what follows."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from torchcloth import identification
from torchcloth._utils.files import write_atomically
from torchcloth.boundaries.motion import interpolate_poses
from torchcloth.errors import InvalidInput
from torchcloth.pose.first_shape import find_grippers, pose_inputs
from torchcloth.pose.network_answers import MIN_POINTS_FOR_NETWORK
from torchcloth.pose.scene_frame import rest_coordinates
from torchcloth.recordings import Recording

from .motions import DATA_SCHEMA, MOTION_KNOT_PERIOD_S, motion_path
from .scenes import FABRIC_RANGES, Fabric

Array = np.ndarray


def write_unlabelled(folder: Path, recordings: Sequence[Recording]) -> int:
    """Write each recording as a file of training data without truth; return the number of frames.

    Raises:
        InvalidInput: no frame with a cloud.
    """
    frames = 0
    for number, recording in enumerate(recordings):
        motion = make_unlabelled_motion(recording, number)
        with write_atomically(motion_path(folder, number)) as part:
            np.savez(part, **motion)  # pyright: ignore[reportArgumentType] - numpy's stub takes it for a flag
        frames += len(motion["times"])
    if not frames:
        raise InvalidInput("--unlabelled", got="no frame with a cloud", expected="recordings with points")
    return frames


def make_unlabelled_motion(recording: Recording, number: int) -> dict[str, Array]:
    """Return the arrays of a motion's file (`data.PoseSample`), with NaN in place of the truth.

    Args:
        recording: one episode. A first shape that it may have is not looked at.
        number: of its file.
    """
    cloth = identification.build_cloth(recording)
    episode = identification.build_episode(cloth, recording, has_first_shape=False)
    rest = rest_coordinates(cloth.mesh)
    frames = [k for k, cloud in enumerate(episode.clouds) if len(cloud) >= MIN_POINTS_FOR_NETWORK]
    seen = [pose_inputs(cloth, episode, frame, rest, seed=frame) for frame in frames]
    names = find_grippers(cloth, rest)
    first = max(float(episode.motion[name].t[0]) for name in names)
    last = min(float(episode.motion[name].t[-1]) for name in names)
    knots = np.arange(first, last, MOTION_KNOT_PERIOD_S)
    poses = [interpolate_poses(episode.motion[name], torch.as_tensor(knots)) for name in names]
    mesh, unknown = cloth.mesh, np.full((len(frames), *rest.shape), np.nan, np.float32)

    def stack(name: str) -> Array:
        return np.stack([getattr(inputs, name)[0].numpy() for inputs in seen]).astype(np.float32)

    return {
        "schema": np.array(DATA_SCHEMA),
        "seed": np.array(number),
        "split": np.array("unlabelled"),
        "novelty": np.array("recording"),
        "kind": np.array("sheet" if mesh.uv is not None else "garment"),
        "grip_kind": np.array(f"{len(names)} grippers"),
        "motion_kind": np.array("recorded"),
        "rejected": np.array(""),
        "has_table": np.array(bool(recording.colliders)),
        "fabric": np.array(_nominal_fabric(recording)),
        "vertices": mesh.vertices.astype(np.float32),
        "faces": mesh.faces.astype(np.int32),
        "pattern": np.asarray(mesh.pattern, np.float32),
        "rest": rest.numpy().astype(np.float32),
        "grip": seen[0].grip[0].numpy().astype(np.int8),
        "frame": np.array(frames, np.int32),
        "times": episode.times[frames].numpy(),
        "points": stack("points"),
        "is_stray": np.zeros((len(frames), seen[0].points.shape[1]), bool),
        "visible": np.ones(len(frames), np.float32),
        "x": unknown,
        "v": unknown,
        "previous": unknown,
        "grip_position": stack("grip_position"),
        "grip_velocity": stack("grip_velocity"),
        "motion_times": knots,
        "motion_pose": np.stack([pose.numpy() for pose in poses]).astype(np.float32),
    }


def _nominal_fabric(recording: Recording) -> Fabric:
    """The data sheet's values, and the middle of the training's ranges for what it does not say."""
    nominal = {name: value for name, value in recording.cloth.nominal.items() if isinstance(value, int | float)}
    nominal["areal_density"] = recording.cloth.areal_density
    middle = {name: float(np.sqrt(low * high)) for name, (low, high) in FABRIC_RANGES.items()}
    return Fabric(**{name: float(nominal.get(name, value)) for name, value in middle.items()})
