"""Writes the Rizon URDF files beside it from one table: ``python robots/urdf/generate.py``.

The three arms share everything but joint 7, link 6, link 7 and the flange, so one table keeps them from drifting apart.

Figures (SI units) are read from Flexiv's public Apache-2.0 repositories; no vendor file is copied. Joints and limits:
flexiv_rdk @ ab70315 (2025-12-04); the wrist of 2022: flexiv_ros2 @ 9d96a86 (2024-01-25); masses and inertias:
flexiv_description 2.0; shapes: cylinders that cover the bounding boxes of the vendor's meshes.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import NamedTuple

URDF_HEADER = """<?xml version="1.0"?>
<!-- Author: torchcloth. Licence: Apache-2.0. Written by generate.py; edit that file, not this one.
     Flexiv {model}, {wrist}.
     Figures: flexiv_rdk @ ab70315, flexiv_ros2 @ 9d96a86 and flexiv_description 2.0 (Apache-2.0); see generate.py.
     Flexiv moved joint 7 by 40 mm on 2024-03-29 and kept the name of the arm: choose the file that fits yours.
     Metres, radians, kilograms. The two gains of each safety_controller are nominal; only its limits are Flexiv's.
     The gripper is a Flexiv Grav (GN01; flexiv_description 2.0, grav_macro.xacro): z 0.150 m from the flange is the
     vendor's centre point for open fingers, z 0.200 m the one for closed fingers. Its fingers are drawn closed. -->
"""


class Variant(NamedTuple):
    """What differs from one arm to the next."""

    model: str
    wrist: str
    joint7_xyz: tuple[float, float, float]  # m
    joint7_pitch: float  # rad
    link6_reach: float  # m, largest x of link 6
    link7_length: float  # m, from joint 7 to the flange
    link7_mass: float  # kg
    link7_com: float  # m, along z


# The vendor writes the pitch of joint 7 as 1e-8 rad off a right angle since 2024, and exactly before.
NEW_WRIST = ("wrist generation 2024 (files dated 2024-03-29 and later)", (-0.015, 0.073, 0.110), -1.5707963478683205)
OLD_WRIST = ("wrist generation 2022 (files dated 2022-08 to 2024-03)", (-0.055, 0.070, 0.110), -1.5707963267948966)

RIZON_VARIANTS = {
    "rizon4": Variant("Rizon 4", *NEW_WRIST, 0.1055, 0.081, 0.8, 0.03),
    "rizon4_gen2022": Variant("Rizon 4", *OLD_WRIST, 0.072, 0.081, 0.8, 0.03),
    "rizon4s": Variant("Rizon 4s", *NEW_WRIST, 0.1055, 0.124, 1.4, 0.05),
}

# xyz, yaw, axis, hard limits, velocity (rad/s), effort (N m); joint 7 is completed by the variant.
RIZON_JOINT_TABLE = [
    ((0, 0, 0.155), -math.pi, "0 0 1", (-2.8798, 2.8798), (-2.7925, 2.7925), 2.0944, 123),
    ((0, 0.030, 0.210), 0, "0 1 0", (-2.3562, 2.3562), (-2.2689, 2.2689), 2.0944, 123),
    ((0, 0.035, 0.205), 0, "0 0 1", (-3.0543, 3.0543), (-2.9671, 2.9671), 2.4435, 64),
    ((-0.020, -0.030, 0.190), -math.pi, "0 1 0", (-1.9548, 2.7751), (-1.8675, 2.6878), 2.4435, 64),
    ((-0.020, 0.025, 0.195), -math.pi, "0 0 1", (-3.0543, 3.0543), (-2.9671, 2.9671), 4.8869, 39),
    ((0, 0.030, 0.190), 0, "0 1 0", (-1.4835, 4.6251), (-1.3963, 4.5379), 4.8869, 39),
    (None, 0, "0 0 1", (-3.0543, 3.0543), (-2.9671, 2.9671), 4.8869, 39),
]

# mass, centre of mass, (ixx, iyy, izz, ixy, ixz, iyz) about it; link 7 is completed by the variant.
LINK_INERTIALS = {
    "base_link": (3.8, (0, 0, 0.09), (0.02, 0.02, 0.01, 0, 0, 0)),
    "link1": (3.6, (0, 0, 0.15), (0.03, 0.03, 0.01, 0, 0, 0)),
    "link2": (2.7, (0, 0.04, 0.10), (0.02, 0.02, 0.004, 0, 0, -0.0003)),
    "link3": (2.4, (-0.01, 0, 0.14), (0.01, 0.01, 0.004, 0, -0.001, -0.0007)),
    "link4": (2.4, (-0.01, 0.03, 0.10), (0.02, 0.02, 0.003, 0, -0.002, -0.001)),
    "link5": (2.3, (0, 0, 0.14), (0.01, 0.01, 0.004, 0, 0, 0.001)),
    "link6": (2.2, (0.02, 0.06, 0.07), (0.01, 0.01, 0.004, 0, -0.001, 0.002)),
    "grav_base_link": (1.186, (0, 0, 0.057), (0.003, 0.003, 0.001, 0, 0, 0)),
}

# Cylinders as (radius, start, end); links 6 and 7 are completed by the variant.
LINK_CYLINDERS = {
    "base_link": [(0.0825, (0, 0, 0), (0, 0, 0.150))],
    "link1": [(0.0615, (0, 0, 0), (0, 0, 0.2715))],
    "link2": [(0.0615, (0, -0.015, 0), (0, 0.089, 0)), (0.055, (0, 0.035, 0), (0, 0.035, 0.200))],
    "link3": [(0.050, (0, 0, 0), (-0.020, 0, 0.240))],
    "link4": [(0.050, (0, -0.025, 0), (0, 0.0825, 0)), (0.050, (-0.020, 0.025, 0), (-0.020, 0.025, 0.190))],
    "link5": [(0.050, (0, 0, 0), (0, 0, 0.240))],
}

# Boxes as (size, centre): the gripper's body, and its two closed finger tips as one.
LINK_BOXES = {
    "grav_base_link": [((0.088, 0.096, 0.1165), (0, 0, 0.05625))],
    "tcp_closed": [((0.0148, 0.040, 0.038), (0, 0, -0.019))],
}


def text(*values: float) -> str:
    """Return numbers as URDF writes them, without loss of precision."""
    return " ".join(repr(float(value)) for value in values)


def add_origin(parent: ET.Element, xyz: tuple, rpy: tuple = (0, 0, 0)) -> None:
    """Append an ``origin`` element to ``parent``."""
    ET.SubElement(parent, "origin", xyz=text(*xyz), rpy=text(*rpy))


def add_link(robot: ET.Element, name: str, inertials: dict, cylinders: dict) -> None:
    """Append a link. A link without figures stays a bare frame: physics engines refuse zero masses."""
    link = ET.SubElement(robot, "link", name=name)
    if name in inertials:
        mass, centre, moments = inertials[name]
        inertial = ET.SubElement(link, "inertial")
        add_origin(inertial, centre)
        ET.SubElement(inertial, "mass", value=text(mass))
        keys = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
        ET.SubElement(inertial, "inertia", {key: text(value) for key, value in zip(keys, moments, strict=True)})
    for tag in ("visual", "collision"):
        for radius, start, end in cylinders.get(name, ()):
            add_cylinder(ET.SubElement(link, tag), radius, start, end)
        for size, centre in LINK_BOXES.get(name, ()):
            shape = ET.SubElement(link, tag)
            add_origin(shape, centre)
            ET.SubElement(ET.SubElement(shape, "geometry"), "box", size=text(*size))


def add_cylinder(shape: ET.Element, radius: float, start: tuple, end: tuple) -> None:
    """Append a cylinder between two points [m]. URDF centres a cylinder and lays it along its own z axis."""
    x, y, z = (b - a for a, b in zip(start, end, strict=True))
    across = math.hypot(x, y)
    middle = tuple(round((a + b) / 2, 9) for a, b in zip(start, end, strict=True))
    add_origin(shape, middle, (0, math.atan2(across, z), math.atan2(y, x)))
    length = round(math.hypot(across, z), 9)
    ET.SubElement(ET.SubElement(shape, "geometry"), "cylinder", radius=text(radius), length=text(length))


def add_joint(robot: ET.Element, name: str, kind: str, parent: str, child: str, xyz: tuple, rpy: tuple) -> ET.Element:
    """Append a joint without axis and limits."""
    joint = ET.SubElement(robot, "joint", name=name, type=kind)
    add_origin(joint, xyz, rpy)
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    return joint


def add_arm_joint(robot: ET.Element, number: int, variant: Variant) -> None:
    """Append ``joint<number>`` with its axis and its hard and soft limits."""
    xyz, yaw, axis, hard, soft, velocity, effort = RIZON_JOINT_TABLE[number - 1]
    pitch = 0.0 if xyz else variant.joint7_pitch
    parent = "base_link" if number == 1 else f"link{number - 1}"
    origin = xyz or variant.joint7_xyz
    joint = add_joint(robot, f"joint{number}", "revolute", parent, f"link{number}", origin, (0, pitch, yaw))
    ET.SubElement(joint, "axis", xyz=axis)
    bounds = {"lower": text(hard[0]), "upper": text(hard[1])}
    ET.SubElement(joint, "limit", bounds, velocity=text(velocity), effort=text(effort))
    gains = {"k_position": text(100), "k_velocity": text(100)}
    ET.SubElement(joint, "safety_controller", gains, soft_lower_limit=text(soft[0]), soft_upper_limit=text(soft[1]))


def render(name: str) -> str:
    """Return the URDF text of one of ``RIZON_VARIANTS``."""
    variant = RIZON_VARIANTS[name]
    link7 = (variant.link7_mass, (0, 0, variant.link7_com), (0.001, 0.001, 0.001, 0, 0, 0))
    inertials = LINK_INERTIALS | {"link7": link7}
    bend = variant.joint7_xyz[1]  # link 6 runs along y, then z, then x, as far from its start as joint 7 is
    elbow = [
        (0.050, (0, 0, 0), (0, 0.080, 0)),
        (0.050, (0, bend, 0), (0, bend, 0.110)),
        (0.050, (variant.joint7_xyz[0], bend, 0.110), (variant.link6_reach, bend, 0.110)),
    ]
    cylinders = LINK_CYLINDERS | {"link6": elbow, "link7": [(0.050, (0, 0, 0), (0, 0, variant.link7_length))]}

    robot = ET.Element("robot", name=name)
    arm = ["base_link", *(f"link{number}" for number in range(1, 8))]
    for link in [*arm, "flange", "grav_base_link", "tcp_open", "tcp_closed"]:
        add_link(robot, link, inertials, cylinders)
    for number in range(1, 8):
        add_arm_joint(robot, number, variant)
    add_joint(robot, "link7_to_flange", "fixed", "link7", "flange", (0, 0, variant.link7_length), (0, 0, -math.pi))
    add_joint(robot, "flange_to_grav", "fixed", "flange", "grav_base_link", (0, 0, 0), (0, 0, 0))
    add_joint(robot, "grav_to_tcp_open", "fixed", "grav_base_link", "tcp_open", (0, 0, 0.150), (0, 0, 0))
    add_joint(robot, "grav_to_tcp_closed", "fixed", "grav_base_link", "tcp_closed", (0, 0, 0.200), (0, 0, 0))
    ET.indent(robot)
    return URDF_HEADER.format(model=variant.model, wrist=variant.wrist) + ET.tostring(robot, encoding="unicode") + "\n"


if __name__ == "__main__":
    for name in RIZON_VARIANTS:
        (Path(__file__).parent / f"{name}.urdf").write_text(render(name))
