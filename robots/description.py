"""From URDF text to the numbers of one serial chain, in float64.

pytorch-kinematics parses the file. Its ``SerialChain`` is not built on top: that rounds joint origins to float32
(1e-7 m), lets mimic joints move freely, takes z where URDF's default axis is x, and writes in place, which stops vmap.
The tests compare the two.
"""

from __future__ import annotations

import contextlib
import io
import math
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchcloth.errors import InvalidInput, MissingDependency

from .rigid import origin_matrix

URDF_FOLDER = Path(str(resources.files("torchcloth.robots"))) / "urdf"
MOVING = ("revolute", "continuous", "prismatic")


class Shape(NamedTuple):
    """A primitive fixed to a body of the chain."""

    kind: str  # "box", "cylinder" or "sphere"
    size: tuple[float, ...]  # m
    link: str
    body: int  # 0 is the root, j moves with joint j (counted from 1)
    pose: Tensor  # [4, 4] m, in that body


class Description(NamedTuple):
    """A serial chain: body j hangs on body j - 1 by ``origin[j - 1]`` and then moves along or about ``axis[j - 1]``."""

    name: str
    joint_names: tuple[str, ...]
    joint_types: tuple[str, ...]
    origin: Tensor  # [J, 4, 4] m
    axis: Tensor  # [J, 3] unit vectors in the joint's own frame
    tip: Tensor  # [4, 4] m, the frame in the last body
    limits: Tensor  # [6, J] lower, upper, soft lower, soft upper, velocity, effort
    shapes: tuple[Shape, ...]
    unshaped: tuple[str, ...]  # links of the chain whose solids are meshes alone


def models() -> list[str]:
    """The names of the arms that come with torchcloth."""
    return sorted(path.stem for path in URDF_FOLDER.glob("*.urdf"))


def locate(name_or_path: str | Path) -> Path:
    """The file behind the name of a shipped arm or a path."""
    if str(name_or_path) in models():
        return URDF_FOLDER / f"{name_or_path}.urdf"
    path = Path(name_or_path)
    if path.is_file():
        return path
    if path.suffix or len(path.parts) > 1:
        raise InvalidInput("there is no such URDF file", got=path, remedy="check the path")
    expected = f"one of {', '.join(models())}, or the path of a URDF file"
    raise InvalidInput("unknown robot name_or_path", got=repr(str(name_or_path)), expected=expected)


def parse(path: Path) -> Any:
    """The URDF file as the parser of pytorch-kinematics sees it (all of its numbers are Python floats)."""
    try:
        from pytorch_kinematics import URDF
    except ImportError as error:
        raise MissingDependency(
            "robots need pytorch-kinematics, which is not installed", remedy='pip install "torchcloth[robots]"'
        ) from error
    try:
        with contextlib.redirect_stderr(io.StringIO()):  # one line for every vendor tag that it does not know
            return URDF.from_xml_string(path.read_bytes())
    except Exception as error:  # the parser raises bare exceptions
        raise InvalidInput(f"{path} is not a URDF file that can be read", got=error, remedy="mend the file") from error


def describe(path: Path, frame: str) -> Description:
    """Reads the chain from the root link to the link ``frame``.

    Raises:
        InvalidInput: the file is not URDF, has no such link, or the chain has a joint that is not one free number.
    """
    robot = parse(path)
    chain = _joints_to(robot, frame, path)
    moving = [joint for joint in chain if joint.type in MOVING]
    if not moving:
        raise InvalidInput(f"no joint of {path} moves {frame!r}", remedy="choose a frame at the end of the arm")

    origins, shapes = [], []
    pending = torch.eye(4, dtype=torch.float64)  # fixed joints are folded into the next moving one
    shapes += _shapes(robot.link_map[chain[0].parent], 0, pending)
    for joint in chain:
        pending = pending @ _matrix(joint.origin)
        if joint.type in MOVING:
            origins.append(pending)
            pending = torch.eye(4, dtype=torch.float64)
        shapes += _shapes(robot.link_map[joint.child], len(origins), pending)
    return Description(
        name=robot.name or path.stem,
        joint_names=tuple(joint.name for joint in moving),
        joint_types=tuple(joint.type for joint in moving),
        origin=torch.stack(origins),
        axis=torch.stack([_axis(joint) for joint in moving]),
        tip=pending,
        limits=torch.tensor([_limits(joint) for joint in moving], dtype=torch.float64).T.contiguous(),
        shapes=tuple(shapes),
        unshaped=_unshaped([robot.link_map[chain[0].parent], *(robot.link_map[joint.child] for joint in chain)]),
    )


def _joints_to(robot: Any, frame: str, path: Path) -> list:
    """The joints from the root to ``frame``, each one checked."""
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
        if joint.type not in (*MOVING, "fixed"):
            expected = f"{', '.join(MOVING)} or fixed"
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
    length = axis.norm()
    if not length > 0:
        raise InvalidInput(f"axis of joint {joint.name!r}", got=joint.axis, expected="a vector that is not zero")
    return axis / length


def _limits(joint: Any) -> tuple[float, ...]:
    """Lower, upper, soft lower, soft upper, velocity, effort; infinite where the file is silent, or a velocity is 0."""
    lower, upper, velocity, effort = -math.inf, math.inf, math.inf, math.inf
    if joint.limit is not None:
        velocity, effort = joint.limit.velocity or math.inf, joint.limit.effort  # 0 is "not stated", as in ROS
        if joint.type != "continuous":  # URDF gives a continuous joint's missing bounds as 0
            lower, upper = joint.limit.lower, joint.limit.upper
    if not velocity > 0:
        raise InvalidInput(f"velocity limit of joint {joint.name!r}", got=velocity, expected="a value > 0")
    if not lower <= upper:
        raise InvalidInput(f"limits of joint {joint.name!r}", got=f"{lower} to {upper}", expected="lower <= upper")
    soft = joint.safety_controller
    if soft is None or soft.soft_lower_limit >= soft.soft_upper_limit:
        return lower, upper, lower, upper, velocity, effort
    within = max(lower, soft.soft_lower_limit), min(upper, soft.soft_upper_limit)
    if not within[0] <= within[1]:
        got, expected = f"{soft.soft_lower_limit} to {soft.soft_upper_limit}", f"some of {lower} to {upper}"
        raise InvalidInput(f"soft limits of joint {joint.name!r}", got=got, expected=expected)
    return lower, upper, *within, velocity, effort


def _shapes(link: Any, body: int, placed: Tensor) -> list[Shape]:
    """The primitives of a link: those it collides with, or those that are shown if it collides with none."""

    def read(elements: list) -> list[Shape]:
        found = [(_primitive(element.geometry), element) for element in elements]
        for primitive, element in found:
            if primitive is not None and not all(0 < size < math.inf for size in primitive[1]):
                what = f"{primitive[0]} of link {link.name!r}, {element.name!r}" if element.name else link.name
                raise InvalidInput(f"size of a solid of {what}", got=primitive[1], expected="finite lengths > 0")
        return [
            Shape(*primitive, link.name, body, placed @ _matrix(element.origin))
            for primitive, element in found
            if primitive is not None
        ]

    return read(link.collisions) or read(link.visuals)


def _unshaped(links: list) -> tuple[str, ...]:
    """Links of which something, that would be in the way, is a mesh."""
    solids = [(link.name, link.collisions or link.visuals) for link in links]
    return tuple(name for name, own in solids if any(_primitive(e.geometry) is None for e in own))


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
