"""The numbers of one serial chain (float64) from a URDF file.

pytorch-kinematics parses the file. Its ``SerialChain`` is not used: it rounds joint origins to float32 (1e-7 m), lets
mimic joints move freely, takes z where URDF's default axis is x, and writes in place, which stops vmap. The tests
compare the two.
"""

from __future__ import annotations

import math
import warnings
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchcloth.errors import InvalidInput

from .link_meshes import MeshShape
from .rigid import origin_matrix
from .urdf_file import parse_urdf

URDF_FOLDER = Path(str(resources.files("torchcloth.robots"))) / "urdf"
MOVING_JOINT_TYPES = ("revolute", "continuous", "prismatic")
MAX_JOINT_LIMIT_RAD = 4 * math.pi  # no joint of an arm turns further
MAX_JOINT_LIMIT_DEG = 720.0  # likewise; larger limits stand for none


class Shape(NamedTuple):
    """A primitive solid that is fixed to a body of the chain.

    Attributes:
        kind: "box", "cylinder" or "sphere".
        size: m, as in ``arm.Primitive``.
        link: name of its link.
        body: 0 is the root; body j moves with joint j, counted from 1.
        pose: [4, 4] m, in that body.
    """

    kind: str
    size: tuple[float, ...]
    link: str
    body: int
    pose: Tensor


class Description(NamedTuple):
    """A serial chain of J joints.

    Body j hangs on body j - 1 by ``origin[j - 1]`` and then moves along or about ``axis[j - 1]``.

    Attributes:
        name: of the robot.
        joint_names: root first.
        joint_types: ``revolute``, ``continuous`` or ``prismatic``.
        origin: [J, 4, 4] m.
        axis: [J, 3], unit vectors in each joint's own frame.
        tip: [4, 4] m, pose of the end frame in the last body.
        limits: [6, J], lower, upper, soft lower, soft upper, velocity, effort.
        shapes: primitive solids.
        mesh_shapes: solids that are mesh files.
        folder: of the URDF file, where its meshes are searched for.
    """

    name: str
    joint_names: tuple[str, ...]
    joint_types: tuple[str, ...]
    origin: Tensor
    axis: Tensor
    tip: Tensor
    limits: Tensor
    shapes: tuple[Shape, ...]
    mesh_shapes: tuple[MeshShape, ...]
    folder: Path


def list_models() -> list[str]:
    """List the names of the arms that come with torchcloth."""
    return sorted(path.stem for path in URDF_FOLDER.glob("*.urdf"))


def locate_urdf(name_or_path: str | Path) -> Path:
    """Return the URDF file of a shipped arm's name or of a path.

    Raises:
        InvalidInput: no such arm or file.
    """
    if str(name_or_path) in list_models():
        return URDF_FOLDER / f"{name_or_path}.urdf"
    path = Path(name_or_path)
    if path.is_file():
        return path
    if path.suffix or len(path.parts) > 1:
        raise InvalidInput("there is no such URDF file", got=path, remedy="check the path")
    expected = f"one of {', '.join(list_models())}, or the path of a URDF file"
    raise InvalidInput("unknown robot name_or_path", got=repr(str(name_or_path)), expected=expected)


def read_description(path: Path, frame: str) -> Description:
    """Read the chain from the root link to the link ``frame``.

    Raises:
        InvalidInput: the file is not URDF or has no such link, or a joint of the chain has not exactly one free
            coordinate.
    """
    robot = parse_urdf(path)
    chain = _joints_to(robot, frame, path)
    moving = [joint for joint in chain if joint.type in MOVING_JOINT_TYPES]
    if not moving:
        raise InvalidInput(f"no joint of {path} moves {frame!r}", remedy="choose a frame at the end of the arm")

    origins, solids = [], []
    pending = torch.eye(4, dtype=torch.float64)  # fixed joints are folded into the next moving one
    solids += _solids(robot.link_map[chain[0].parent], 0, pending)
    for joint in chain:
        pending = pending @ _matrix(joint.origin)
        if joint.type in MOVING_JOINT_TYPES:
            origins.append(pending)
            pending = torch.eye(4, dtype=torch.float64)
        solids += _solids(robot.link_map[joint.child], len(origins), pending)
    return Description(
        name=robot.name or path.stem,
        joint_names=tuple(joint.name for joint in moving),
        joint_types=tuple(joint.type for joint in moving),
        origin=torch.stack(origins),
        axis=torch.stack([_axis(joint) for joint in moving]),
        tip=pending,
        limits=torch.tensor([_limits(joint) for joint in moving], dtype=torch.float64).T.contiguous(),
        shapes=tuple(solid for solid in solids if isinstance(solid, Shape)),
        mesh_shapes=tuple(solid for solid in solids if isinstance(solid, MeshShape)),
        folder=path.resolve().parent,
    )


def _joints_to(robot: Any, frame: str, path: Path) -> list:
    """Joints from the root to ``frame``, each one checked."""
    if frame not in robot.link_map:
        raise InvalidInput(
            f"{path} has no link for frame", got=repr(frame), expected=f"one of {', '.join(robot.link_map)}"
        )
    chain: list = []
    link = frame
    while link in robot.parent_map:
        name, link = robot.parent_map[link]
        joint = robot.joint_map[name]
        if joint in chain or link not in robot.link_map:
            raise InvalidInput(f"joint {name!r} of {path} closes a loop or has no parent link", got=repr(link))
        if joint.mimic is not None:
            remedy = "choose a frame before it, or make the joint fixed"
            raise InvalidInput(f"joint {name!r} mimics {joint.mimic.joint!r}: it is no free joint", remedy=remedy)
        if joint.type not in (*MOVING_JOINT_TYPES, "fixed"):
            expected = f"{', '.join(MOVING_JOINT_TYPES)} or fixed"
            raise InvalidInput(f"joint {name!r} on the way to {frame!r}", got=f"type {joint.type!r}", expected=expected)
        chain.insert(0, joint)
    return chain


def _matrix(origin: Any) -> Tensor:
    if origin is None:
        return torch.eye(4, dtype=torch.float64)
    matrix = origin_matrix(origin.xyz, origin.rpy)
    if not bool(torch.isfinite(matrix).all()):
        raise InvalidInput("origin in a URDF", got=f"xyz {origin.xyz}, rpy {origin.rpy}", expected="finite numbers")
    return matrix


def _axis(joint: Any) -> Tensor:
    axis = torch.tensor(joint.axis or [1.0, 0.0, 0.0], dtype=torch.float64)
    largest = axis.abs().max()
    if not largest > 0:
        raise InvalidInput(f"axis of joint {joint.name!r}", got=joint.axis, expected="a vector that is not zero")
    axis = axis / largest  # the square of its length could overflow, or vanish
    return axis / axis.norm()


def _limits(joint: Any) -> tuple[float, ...]:
    """Lower, upper, soft lower, soft upper, velocity, effort; infinite if the file gives none, or a velocity of 0."""
    lower, upper, velocity, effort = -math.inf, math.inf, math.inf, math.inf
    if joint.limit is not None:
        velocity, effort = joint.limit.velocity or math.inf, joint.limit.effort  # 0 is "not stated", as in ROS
        if joint.type != "continuous":  # URDF gives a continuous joint's missing bounds as 0
            lower, upper = joint.limit.lower, joint.limit.upper
    if not velocity > 0:
        raise InvalidInput(f"velocity limit of joint {joint.name!r}", got=velocity, expected="a value > 0")
    if not lower <= upper:
        raise InvalidInput(f"limits of joint {joint.name!r}", got=f"{lower} to {upper}", expected="lower <= upper")
    _warn_of_strange_limits(joint, lower, upper)
    soft = joint.safety_controller
    if soft is None or soft.soft_lower_limit >= soft.soft_upper_limit:
        return lower, upper, lower, upper, velocity, effort
    within = max(lower, soft.soft_lower_limit), min(upper, soft.soft_upper_limit)
    if not within[0] <= within[1]:
        got, expected = f"{soft.soft_lower_limit} to {soft.soft_upper_limit}", f"some of {lower} to {upper}"
        raise InvalidInput(f"soft limits of joint {joint.name!r}", got=got, expected=expected)
    return lower, upper, *within, velocity, effort


def _warn_of_strange_limits(joint: Any, lower: float, upper: float) -> None:
    """Warn of a joint that cannot move, and of limits in degrees: kinematics are right, plans and limits are not."""
    if lower == upper:
        text = f"{lower:g} to {upper:g}, so it cannot move; state its limits, or make it continuous or fixed"
    elif joint.type == "revolute" and MAX_JOINT_LIMIT_RAD < max(abs(lower), abs(upper)) <= MAX_JOINT_LIMIT_DEG:
        text = f"{lower:g} to {upper:g} rad, which look like degrees; multiply them by pi / 180"
    else:
        return
    warnings.warn(f"limits of joint {joint.name!r} are {text}", stacklevel=2)


def _solids(link: Any, body: int, placed: Tensor) -> list[Shape | MeshShape]:
    """Solids of a link: its collision shapes, or its visual ones if it has no others or only those are primitives."""
    elements, visuals = link.collisions or link.visuals, link.visuals
    if not any(_primitive(e.geometry) for e in elements) and any(_primitive(e.geometry) for e in visuals):
        elements = visuals
    solids: list[Shape | MeshShape] = []
    for element in elements:
        primitive, pose = _primitive(element.geometry), placed @ _matrix(element.origin)
        if primitive is None:
            file, scale = getattr(element.geometry, "filename", None), getattr(element.geometry, "scale", None)
            solids.append(MeshShape(file or "", _scale(scale), link.name, body, pose))
            continue
        kind, size = primitive
        if not all(0 < length < math.inf for length in size):
            what = f"size of a {kind} of link {link.name!r}"
            raise InvalidInput(what, got=size, expected="finite lengths > 0")
        solids.append(Shape(kind, size, link.name, body, pose))
    return solids


def _scale(scale: Any) -> tuple[float, float, float]:
    x, y, z = (1.0, 1.0, 1.0) if scale is None or len(scale) != 3 else map(float, scale)
    return x, y, z


def _primitive(geometry: Any) -> tuple[str, tuple[float, ...]] | None:
    """Kind and size; None for a mesh."""
    match type(geometry).__name__:
        case "Box":
            return "box", tuple(geometry.size)
        case "Cylinder":
            return "cylinder", (geometry.radius, geometry.length)
        case "Sphere":
            return "sphere", (geometry.radius,)
    return None
