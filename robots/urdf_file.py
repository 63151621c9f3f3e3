"""Parsing of a URDF file, with checks of everything that its parser would take for something else."""

from __future__ import annotations

import contextlib
import io
import math
from collections import Counter
from pathlib import Path
from typing import Any

from torchcloth.errors import InvalidInput, MissingDependency

ROBOT_TAG = "robot"
XACRO_NAMESPACE_PART = "/xacro"  # of every address that xacro files give for their namespace
XACRO_EXPRESSIONS = ("${", "$(")
XACRO_REMEDY = "expand it: xacro FILE.urdf.xacro > FILE.urdf"
OTHER_ROOT_TAGS = {  # by the first element: what the file is, and the remedy
    "mujoco": ("an MJCF model of MuJoCo", "take the URDF that the model was made from, or export one"),
    "sdf": ("an SDF model of Gazebo", "take the URDF that the model was made from, or export one"),
    "COLLADA": ("a COLLADA mesh", "pass the URDF that names the mesh"),
    "launch": ("a launch file of ROS", "pass the URDF that it loads"),
    "html": ("a web page", "download the raw file"),
}
NUMERIC_ATTRIBUTES = {  # by element, what URDF gives as numbers
    "origin": ("xyz", "rpy"),
    "axis": ("xyz",),
    "box": ("size",),
    "cylinder": ("radius", "length"),
    "sphere": ("radius",),
    "mesh": ("scale",),
    "limit": ("lower", "upper", "velocity", "effort"),
    "safety_controller": ("soft_lower_limit", "soft_upper_limit", "k_position", "k_velocity"),
    "dynamics": ("damping", "friction"),
    "mimic": ("multiplier", "offset"),
    "mass": ("value",),
    "inertia": ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"),
}
LIMIT_TAGS = ("limit", "safety_controller")  # whose numbers may be infinite: no limit
PLURAL_NAMES = {"limit": "limits", "safety_controller": "soft limits"}


def parse_urdf(path: Path) -> Any:
    """Parse a URDF file by pytorch-kinematics (all of its numbers are Python floats).

    External entities are never resolved: a URDF cannot read other files.

    Raises:
        MissingDependency: pytorch-kinematics is not installed.
        InvalidInput: the file cannot be read, is of another kind, names two links or joints alike, or holds numbers
            that are not finite.
    """
    try:
        from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]  (no stubs)
        from pytorch_kinematics import URDF
    except ImportError as error:
        raise MissingDependency(
            "robots need pytorch-kinematics, which is not installed", remedy='pip install "torchcloth[robots]"'
        ) from error
    parser = etree.XMLParser(resolve_entities="internal", no_network=True, load_dtd=False, remove_comments=True)
    content = b""
    try:
        content = path.read_bytes()
        root = etree.fromstring(content, parser)
    except (OSError, etree.XMLSyntaxError) as error:
        is_xacro = b"<xacro:" in content
        got, remedy = ("a xacro file", XACRO_REMEDY) if is_xacro else (error, "mend the file")
        raise InvalidInput(f"{path} is not a URDF file that can be read", got=got, remedy=remedy) from error
    _check_kind(root, path)
    _check_names(root, path)
    _check_numbers(root, path)
    try:
        with contextlib.redirect_stderr(io.StringIO()):  # one line for every vendor tag that it does not know
            return URDF.from_xml_string(etree.tostring(root))
    except Exception as error:  # the parser raises bare exceptions
        raise InvalidInput(f"{path} is not a URDF file that can be read", got=error, remedy="mend the file") from error


def _check_kind(root: Any, path: Path) -> None:
    """Refuse models of other kinds, and xacro that was not expanded."""
    elements = [element for element in root.iter() if isinstance(element.tag, str)]
    expressions = (
        value
        for element in elements
        for key, value in element.items()
        if key in ("name", "link", *NUMERIC_ATTRIBUTES.get(element.tag, ()))
        and any(mark in value for mark in XACRO_EXPRESSIONS)
    )
    macro = next((e.tag for e in elements if e.tag.startswith("{") and XACRO_NAMESPACE_PART in e.tag), None)
    if macro is not None or (macro := next(expressions, None)) is not None:
        got = f"a xacro file that was not expanded ({macro.rpartition('}')[2] if macro.startswith('{') else macro})"
        raise InvalidInput(f"{path} is no URDF", got=got, expected="a URDF", remedy=XACRO_REMEDY)
    if root.tag != ROBOT_TAG:
        what, remedy = OTHER_ROOT_TAGS.get(root.tag, (f"a file that begins with <{root.tag}>", "check the path"))
        raise InvalidInput(f"{path} is no URDF", got=what, expected="<robot> as its first element", remedy=remedy)


def _check_names(root: Any, path: Path) -> None:
    """Refuse two links or joints of one name, and a link that hangs on two joints: one of them would be ignored."""
    for tag in ("link", "joint"):
        counts = Counter(element.get("name") for element in root.findall(tag))
        twice = [name for name, count in counts.items() if name is not None and count > 1]
        if twice:
            raise InvalidInput(
                f"{path} has two {tag}s of one name",
                got=", ".join(map(repr, twice[:3])) + (f" and {len(twice) - 3} more" if len(twice) > 3 else ""),
                expected=f"another name for each {tag}",
                remedy="two arms of one kind need the prefix argument of their xacro, e.g. left_ and right_",
            )
    children = Counter(child.get("link") for child in root.findall("joint/child"))
    shared = next((name for name, count in children.items() if count > 1), None)
    if shared is not None:
        raise InvalidInput(
            f"{path}: link {shared!r}", got=f"{children[shared]} joints above it", expected="one parent, as in a tree"
        )


def _check_numbers(root: Any, path: Path) -> None:
    """Refuse numbers that are not finite; limits may be infinite."""
    for owner in (*root.findall("link"), *root.findall("joint")):
        for element in owner.iter():
            for key in NUMERIC_ATTRIBUTES.get(element.tag, ()) if isinstance(element.tag, str) else ():
                text = element.get(key, "")
                numbers = [number for word in text.split() if (number := _to_number(word)) is not None]
                if all(map(math.isfinite, numbers)):
                    continue
                if element.tag in LIMIT_TAGS and not any(map(math.isnan, numbers)):
                    continue
                what = f"{PLURAL_NAMES.get(element.tag, element.tag)} of {owner.tag} {owner.get('name')!r} in {path}"
                raise InvalidInput(what, got=f'{key}="{text}"', expected="finite numbers")


def _to_number(word: str) -> float | None:
    """Return the number; None for another word, which the parser refuses."""
    try:
        return float(word)
    except ValueError:
        return None
