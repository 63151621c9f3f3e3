"""URDF files that mean something else than they say are refused in one line that names the fault."""

from __future__ import annotations

from pathlib import Path

import pytest

import torchcloth.robots as robots
from torchcloth.errors import InvalidInput

BOX = '<collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision>'
JOINT_LIMIT_XML = '<limit lower="-1" upper="1" velocity="2" effort="5"/>'
ARM = f"""<robot name="arm"><link name="base"/>
<link name="tip"><inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
{BOX}</link>
<joint name="turn" type="revolute"><origin xyz="0 0 0.1" rpy="0 0 0"/><parent link="base"/><child link="tip"/>
<axis xyz="0 0 1"/>{JOINT_LIMIT_XML}</joint></robot>"""


@pytest.fixture
def write(tmp_path):
    """A function that writes the arm with one text replaced."""

    def make(old: str = "", new: str = "", text: str = ARM):
        assert old in text
        path = tmp_path / "arm.urdf"
        path.write_text(text.replace(old, new) if old else text)
        return path

    return make


def refuse(path, match):
    with pytest.raises(InvalidInput, match=match) as caught:
        robots.load(path, frame="tip")
    assert "\n" not in str(caught.value)


def test_two_arms_whose_joints_have_the_same_names(write):
    """Of two xacros without a prefix: the left arm's links hung on the right arm's base, 0.8 m away."""
    arms = "".join(
        f'<link name="{side}_base"/><link name="{side}_tip"/>'
        f'<joint name="mount_{side}" type="fixed"><origin xyz="0 {y} 0"/><parent link="world"/>'
        f'<child link="{side}_base"/></joint><joint name="joint1" type="revolute"><parent link="{side}_base"/>'
        f'<child link="{side}_tip"/><axis xyz="0 0 1"/>{JOINT_LIMIT_XML}</joint>'
        for side, y in (("left", 0.4), ("right", -0.4))
    )
    path = write(text=f'<robot name="two"><link name="world"/>{arms}</robot>')
    with pytest.raises(InvalidInput, match=r"two joints of one name; got 'joint1'; .*prefix"):
        robots.load(path, frame="left_tip")


def test_two_links_of_one_name(write):
    refuse(write('<link name="base"/>', '<link name="base"/><link name="base"/>'), "two links of one name; got 'base'")


def test_a_link_that_hangs_on_two_joints(write):
    second = '<link name="wall"/><joint name="weld" type="fixed"><parent link="wall"/><child link="tip"/></joint>'
    refuse(write("</robot>", second + "</robot>"), "link 'tip'; got 2 joints above it; expected one parent")


@pytest.mark.parametrize("size", ["0 0.1 0.1", "0.1 -0.1 0.1"])
@pytest.mark.parametrize("tag", ["collision", "visual"])
def test_a_solid_without_a_size(write, size, tag):
    path = write(BOX, BOX.replace("0.1 0.1 0.1", size).replace("collision", tag))
    refuse(path, r"size of a box of link 'tip'; got .*; expected finite lengths > 0")


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ('rpy="0 0 0"', 'rpy="0 0 inf"', "origin of joint 'turn' in .*; got rpy=\"0 0 inf\""),
        ('xyz="0 0 0.1"', 'xyz="0 nan 0.1"', "origin of joint 'turn'"),
        ('xyz="0 0 1"', 'xyz="0 0 -inf"', "axis of joint 'turn'"),
        ('size="0.1 0.1 0.1"', 'size="0.1 0.1 1e999"', "box of link 'tip'"),
        ('effort="5"', 'effort="nan"', "limits of joint 'turn'"),
        ('velocity="2"', 'velocity="NaN"', "limits of joint 'turn'"),
        ('mass value="1"', 'mass value="inf"', "mass of link 'tip'"),
        ('ixx="1"', 'ixx="nan"', "inertia of link 'tip'"),
    ],
)
def test_a_number_that_is_not_finite(write, old, new, match):
    refuse(write(old, new), match + ".*expected finite numbers")


def test_infinite_limits_are_none(write):
    path = write('lower="-1" upper="1"', 'lower="-inf" upper="inf"')
    assert robots.load(path, frame="tip").limits.upper.tolist() == [float("inf")]


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ('<mujoco model="m"><worldbody/></mujoco>', "no URDF; got an MJCF model of MuJoCo; .*export one"),
        ('<sdf version="1.6"/>', "no URDF; got an SDF model"),
        ("<html><body/></html>", "no URDF; got a web page"),
        ("<machine/>", "no URDF; got a file that begins with <machine>; expected <robot>"),
        (
            '<robot name="x" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:arm/></robot>',
            r"got a xacro file that was not expanded \(arm\); .*xacro FILE.urdf.xacro > FILE.urdf",
        ),
        ('<robot name="x"><xacro:arm/></robot>', "got a xacro file"),
        (ARM.replace('"0 0 0.1"', '"0 0 ${height}"'), r"xacro file that was not expanded \(0 0 \$\{height\}\)"),
    ],
)
def test_a_model_of_another_kind(write, text, match):
    refuse(write(text=text), match)


def test_an_expanded_xacro_is_read(write):
    path = write('<robot name="arm">', '<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro">')
    assert robots.load(path, frame="tip").joint_names == ("turn",)


@pytest.mark.parametrize(
    ("limits", "match"),
    [
        ('lower="0" upper="0"', "limits of joint 'turn' are 0 to 0, so it cannot move"),
        ("", "limits of joint 'turn' are 0 to 0, so it cannot move"),
        ('lower="-170" upper="170"', "limits of joint 'turn' are -170 to 170 rad, which look like degrees"),
    ],
)
def test_strange_limits_are_named(write, limits, match):
    path = write('lower="-1" upper="1"', limits)
    with pytest.warns(UserWarning, match=match):
        robots.load(path, frame="tip")


def test_a_urdf_reads_no_other_file(write, tmp_path):
    """An external entity would bring the secret into the name of the robot's link, and so into messages."""
    secret = tmp_path / "secret"
    secret.write_text("tip")
    declared = f'<!DOCTYPE robot [<!ENTITY s SYSTEM "{secret.as_uri()}">]>'
    text = declared + ARM.replace('<link name="base"/>', '<link name="base"><visual>&s;</visual></link>')
    refuse(write(text=text), "not a URDF file that can be read; got Entity 's' not defined")


def test_an_lxml_that_resolves_entities_of_files_cannot_be_installed():
    text = (Path(__file__).parents[2] / "pyproject.toml").read_text()
    assert '"lxml>=5"' in text


def test_entities_of_entities_are_refused(write):
    """Ten lines that stand for a billion words."""
    entities = '<!ENTITY e0 "lol">' + "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10}">' for i in range(1, 10))
    text = f"<!DOCTYPE robot [{entities}]>" + ARM.replace('"0 0 0.1"', '"&e9;"')
    refuse(write(text=text), "not a URDF file that can be read; got .*entity")


def test_an_entity_of_the_file_itself_is_resolved(write):
    text = '<!DOCTYPE robot [<!ENTITY height "0.1">]>' + ARM.replace('"0 0 0.1"', '"0 0 &height;"')
    assert robots.load(write(text=text), frame="tip").joint_names == ("turn",)
