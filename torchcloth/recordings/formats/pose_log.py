"""Poses of a gripper in a CSV file: a time, a position and a quaternion in each row."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...errors import RecordingError
from .. import checks
from .imported import order_by_stamp, to_pose_matrices, to_quaternions, to_seconds
from .tables import Table, TimeUnit, find_time_columns, read_stamps, read_table

MAX_POSE_INTERVAL_S = 0.5  # between two rows of a log of poses
MIN_SPIKE_M = 0.05  # distance of a single sample from both of its neighbours that no arm covers between two samples
POSITION_HEADS = ("pos_{}", "{}", "t{}", "p{}")  # of the column of a coordinate x, y or z
QUATERNION_HEADS = ("orn_{}", "q{}", "rot_{}", "quat_{}")  # likewise of w, x, y or z
POSITION_END, QUATERNION_END = "position.{}", "orientation.{}"  # of the names that ROS gives


class PoseLog(NamedTuple):
    """Poses over time.

    Attributes:
        ns: [K] ns, as recorded, increasing.
        position: [K, 3] m.
        quat_wxyz: [K, 4] unit quaternions.
        notes: what was guessed and left out.
    """

    ns: np.ndarray
    position: np.ndarray
    quat_wxyz: np.ndarray
    notes: tuple[str, ...]

    def to_motion(self, start_ns: int, closed: np.ndarray, T_world_base: np.ndarray) -> dict[str, np.ndarray]:
        """Return a group of motion.npz.

        Args:
            start_ns: time that becomes 0 s.
            closed: [K] bool.
            T_world_base: [4, 4] m, pose in the world of the frame in which the poses are given.
        """
        rotation, quaternions = T_world_base[:3, :3], self.quat_wxyz
        if not np.array_equal(rotation, np.eye(3)):
            quaternions = to_quaternions(rotation @ to_pose_matrices(self.position, quaternions, "poses")[:, :3, :3])
        position = self.position @ rotation.T + T_world_base[:3, 3]
        return {"t": to_seconds(self.ns, start_ns), "position": position, "quat_wxyz": quaternions, "closed": closed}


def read_pose_log(path: Path, unit: TimeUnit | None = None) -> PoseLog:
    """Read the poses of a gripper.

    Columns are recognised by their heads: pos_x, x, tx or one that ends with position.x; orn_w, qw or one that ends
    with orientation.w; and so on. A single sample that jumps by more than 50 mm and back is left out.

    Args:
        path: the CSV file.
        unit: of the times; None: as the header says, or guessed.

    Raises:
        RecordingError: the file is no table, or holds no poses.
    """
    table = read_table(path)
    columns = [_find_column(table, k, POSITION_HEADS, POSITION_END) for k in "xyz"]
    columns += [_find_column(table, k, QUATERNION_HEADS, QUATERNION_END) for k in "wxyz"]
    stamps = read_stamps(table, find_time_columns(table), MAX_POSE_INTERVAL_S, unit)
    order, order_notes = order_by_stamp(stamps.ns.tolist(), ["\0".join(row).encode() for row in table.rows], path.name)
    ns, values = stamps.ns[order], checks.check_array(table.numbers(columns), str(path), ("N", 7))[order]
    checks.check_increasing(to_seconds(ns, int(ns[0])), str(path))
    checks.check_metres(values[:, :3], str(path))
    quaternions = checks.normalise_unit(values[:, 3:], f"{path}: quaternions")
    is_spike = _find_spikes(values[:, :3])
    notes = [*table.notes, *stamps.notes, *order_notes]
    if is_spike.any():
        notes.append(f"{path.name}: {is_spike.sum()} of {len(ns)} samples jump to and fro and are left out")
    return PoseLog(ns[~is_spike], values[~is_spike, :3], quaternions[~is_spike], tuple(notes))


def _find_column(table: Table, coordinate: str, names: tuple[str, ...], end: str) -> int:
    heads = [head.lower() for head in table.heads or ()]
    wanted = [name.format(coordinate) for name in names]
    matching = [k for k, head in enumerate(heads) if head in wanted or head.endswith(end.format(coordinate))]
    if len(matching) != 1:
        got = f"{len(matching)} columns" if heads else "no header"
        expected = f"one column {', '.join(wanted)} or one that ends with {end.format(coordinate)}"
        raise RecordingError(f"{table.path} holds no poses", got=got, expected=expected, remedy="rename the columns")
    return matching[0]


def _find_spikes(position: np.ndarray) -> np.ndarray:
    """Return [K] bool, whether a sample is far from both neighbours, which are near each other."""
    step = np.linalg.norm(np.diff(position, axis=0), axis=1)
    across = np.linalg.norm(position[2:] - position[:-2], axis=1)
    is_spike = np.zeros(len(position), dtype=bool)
    is_spike[1:-1] = (step[:-1] > MIN_SPIKE_M) & (step[1:] > MIN_SPIKE_M) & (across < MIN_SPIKE_M)
    return is_spike
