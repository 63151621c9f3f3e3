"""Joint angles of an arm in a CSV file of any logger.

Columns are matched by the joints' names in the header, by a numbered group of columns such as q1 to q7, or by their
order. Degrees are told from radians by the joints' limits.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from ...errors import RecordingError
from .imported import order_by_stamp
from .tables import Table, TimeUnit, find_time_columns, read_stamps, read_table, split_words

AngleUnit = Literal["rad", "deg"]
MAX_JOINT_INTERVAL_S = 0.5  # between two rows of a log of joints
MAX_RADIANS = 4 * np.pi  # no joint of an arm turns further
LIMIT_TOLERANCE_RAD = 0.1
POSITION_WORDS = frozenset(("q", "pos", "position", "positions", "joint", "joints", "angle", "angles", "theta", "j"))
OTHER_WORDS = frozenset(
    (
        "qd",
        "qdd",
        "dq",
        "ddq",
        "vel",
        "velocity",
        "velocities",
        "speed",
        "effort",
        "efforts",
        "torque",
        "torques",
        "tau",
        "current",
        "currents",
        "acc",
        "acceleration",
        "accelerations",
        "target",
        "targets",
        "desired",
        "command",
        "commanded",
        "cmd",
        "setpoint",
        "moment",
        "temperature",
        "voltage",
        "error",
    )
)  # of columns that are no measured positions
CLOSED_WORDS = frozenset(("closed", "gripping", "grasped", "holding"))
TRUE_WORDS, FALSE_WORDS = frozenset(("1", "1.0", "true")), frozenset(("0", "0.0", "false"))
DEGREE_WORDS = frozenset(("deg", "degree", "degrees"))
MAX_SHOWN_HEADS = 20


class JointNames(NamedTuple):
    """The joints of an arm, from its base to its tool.

    Attributes:
        names: J names.
        is_prismatic: [J] bool.
        lower, upper: [J] rad or m, limits; infinite where there are none.
        arm: name of the arm, which tells its columns from those of another arm with joints of the same names.
    """

    names: tuple[str, ...]
    is_prismatic: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    arm: str = ""


class JointLog(NamedTuple):
    """Joint positions over time.

    Attributes:
        ns: [K] ns, as recorded, increasing.
        q: [K, J] rad, or m of prismatic joints.
        closed: [K] bool, whether the gripper is closed; None: the file does not say.
        notes: what was guessed and left out.
    """

    ns: np.ndarray
    q: np.ndarray
    closed: np.ndarray | None
    notes: tuple[str, ...]


def read_joint_log(
    path: Path, joints: JointNames, *, angle_unit: AngleUnit | None = None, time_unit: TimeUnit | None = None
) -> JointLog:
    """Read the positions of an arm's joints.

    Args:
        path: the CSV file.
        joints: of the arm.
        angle_unit: of revolute joints; None: as the header says, or guessed.
        time_unit: of the times; None: as the header says, or guessed.

    Raises:
        RecordingError: the file is no table, does not hold the joints, or holds angles that no unit explains.
    """
    table = read_table(path)
    times = find_time_columns(table)
    stamps = read_stamps(table, times, MAX_JOINT_INTERVAL_S, time_unit)
    columns, column_notes = _find_columns(table, joints, [k for k in times if k is not None])
    order, order_notes = order_by_stamp(stamps.ns.tolist(), ["\0".join(row).encode() for row in table.rows], path.name)
    q, angle_notes = _to_radians(table, columns, joints, angle_unit)
    closed = _read_closed(table)
    notes = [*table.notes, *stamps.notes, *column_notes, *angle_notes, *order_notes]
    repeated = np.flatnonzero(np.diff(stamps.ns[order]) == 0)
    if len(repeated):
        raise RecordingError(
            f"{path}: two rows have one time",
            got=f"{len(repeated)} times, first in row {int(order[repeated[0] + 1]) + 1}",
            expected="times that increase",
            remedy="write more digits of the times",
        )
    return JointLog(stamps.ns[order], q[order], None if closed is None else closed[order], tuple(notes))


def _find_columns(table: Table, joints: JointNames, times: list[int]) -> tuple[list[int], list[str]]:
    """Return the column of each joint, and notes on how they were recognised."""
    names, arm = joints.names, set(split_words(joints.arm))
    rest = [k for k in range(len(table.rows[0])) if k not in times]
    if table.heads is None:
        if len(rest) < len(names):
            raise _missing(table, names, f"{len(rest)} columns besides the time")
        notes = [_describe_order(table, names, rest[: len(names)])]
        if len(rest) > len(names):
            notes.append(f"{table.path.name}: {len(rest) - len(names)} columns after the joints are not used")
        return rest[: len(names)], notes
    heads, words = table.heads, [split_words(head) for head in table.heads]
    of_arm = [k for k in rest if arm and arm <= set(words[k])]
    rest = of_arm if len(of_arm) >= len(names) else rest
    by_name = [_columns_of_joint(name, heads, words, rest) for name in names]
    if all(len(columns) == 1 for columns in by_name):
        return [columns[0] for columns in by_name], []
    doubled = next((k for k, columns in enumerate(by_name) if len(columns) > 1), None)
    if doubled is not None:
        got = ", ".join(repr(heads[k]) for k in by_name[doubled])
        what = f"{table.path}: joint {names[doubled]!r} has several columns"
        raise RecordingError(what, got=got, expected="one column of positions", remedy="rename or remove the others")
    measured = [k for k in rest if not OTHER_WORDS.intersection(words[k]) and not CLOSED_WORDS.intersection(words[k])]
    groups: dict[str, list[int]] = {}
    for k in measured:
        if POSITION_WORDS.intersection(words[k]) and re.search(r"\d", heads[k]):
            groups.setdefault(re.sub(r"\d+", "#", heads[k]), []).append(k)
    fitting = [columns for columns in groups.values() if len(columns) == len(names)]
    if len(fitting) != 1 and len(measured) == len(names):
        fitting = [measured]
    if len(fitting) != 1:
        raise _missing(table, names, ", ".join(heads[:MAX_SHOWN_HEADS]))
    return fitting[0], [_describe_order(table, names, fitting[0])]


def _columns_of_joint(name: str, heads: tuple[str, ...], words: list[list[str]], rest: list[int]) -> list[int]:
    """Columns of one joint's positions: the head is its name, or contains it among others such as a topic's."""
    equal = [k for k in rest if heads[k].lower() == name.lower()]
    if equal:
        return equal
    wanted = "_" + "_".join(split_words(name)) + "_"
    containing = [k for k in rest if wanted in "_" + "_".join(words[k]) + "_" and not OTHER_WORDS & set(words[k])]
    stated = [k for k in containing if POSITION_WORDS & (set(words[k]) - set(split_words(name)))]
    return stated or containing


def _describe_order(table: Table, names: tuple[str, ...], columns: list[int]) -> str:
    heads = [str(k + 1) if table.heads is None else table.heads[k] for k in columns]
    return f"{table.path.name}: columns {', '.join(heads)} are, by their order, {', '.join(names)}"


def _missing(table: Table, names: tuple[str, ...], got: str) -> RecordingError:
    return RecordingError(
        f"{table.path} does not hold the {len(names)} joints",
        got=got,
        expected=f"a time and {', '.join(names)}",
        remedy="name the columns as the URDF names the joints, or check the tool frame",
    )


def _to_radians(
    table: Table, columns: list[int], joints: JointNames, unit: AngleUnit | None
) -> tuple[np.ndarray, list[str]]:
    """Return positions [K, J], and a note on a unit that was guessed."""
    q = table.numbers(columns)
    turns, notes = ~joints.is_prismatic, []
    if table.heads is not None and any(DEGREE_WORDS.intersection(split_words(table.heads[k])) for k in columns):
        unit = unit or "deg"
    if unit is None and turns.any():
        reach = float(np.abs(q[:, turns]).max())
        in_degrees = np.where(turns, np.radians(q), q)
        if reach <= 2 * np.pi or _is_possible(q, joints):
            unit, why = "rad", f"at most {reach:.3g} in size"
        elif _is_possible(in_degrees, joints):
            unit, why = "deg", f"up to {reach:.3g} in size, which is beyond the joints' limits in radians"
        else:
            raise RecordingError(
                f"{table.path} holds angles that the arm cannot take",
                got=f"up to {reach:.4g}",
                expected="radians or degrees within the limits of the URDF's joints",
                remedy="check the order of the columns, or state --angles",
            )
        notes = [f"{table.path.name}: joint angles in {'radians' if unit == 'rad' else 'degrees'} ({why})"]
    return (np.where(turns, np.radians(q), q) if unit == "deg" else q), notes


def _is_possible(q: np.ndarray, joints: JointNames) -> bool:
    within = (q >= joints.lower - LIMIT_TOLERANCE_RAD) & (q <= joints.upper + LIMIT_TOLERANCE_RAD)
    return bool(within.all() and (np.abs(q[:, ~joints.is_prismatic]) <= MAX_RADIANS).all())


def _read_closed(table: Table) -> np.ndarray | None:
    """Whether the gripper is closed [K], if a column says so by zeros and ones or false and true."""
    for k, head in enumerate(table.heads or ()):
        if CLOSED_WORDS.intersection(split_words(head)):
            words = {cell.lower() for cell in table.column(k)}
            if words <= TRUE_WORDS | FALSE_WORDS:
                return np.array([cell.lower() in TRUE_WORDS for cell in table.column(k)])
    return None
