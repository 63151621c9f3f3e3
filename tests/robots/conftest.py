from pathlib import Path

import pytest
import torch

pytest.importorskip("pytorch_kinematics")

CRANE = """<?xml version="1.0" encoding="utf-8"?>
<robot name="crane">
  <vendor_tag/>
  <link name="ground"><visual><geometry><box size="1 2 0.5"/></geometry></visual></link>
  <link name="mast"/>
  <link name="trolley">
    <collision>
      <origin xyz="0.1 0 0" rpy="0 1.5707963267948966 0"/>
      <geometry><cylinder radius="0.05" length="0.4"/></geometry>
    </collision>
    <visual><geometry><mesh filename="nowhere.stl"/></geometry></visual>
  </link>
  <link name="boom"/>
  <link name="hook"><visual><geometry><sphere radius="0.03"/></geometry></visual></link>
  <link name="finger"/>
  <link name="puck"/>
  <link name="aside"/>
  <joint name="slew" type="continuous">
    <origin xyz="0 0 1" rpy="0.1 -0.2 0.3"/><parent link="ground"/><child link="mast"/><axis xyz="0 0 2"/>
  </joint>
  <joint name="travel" type="prismatic">
    <parent link="mast"/><child link="trolley"/><limit lower="0.2" upper="1.5" velocity="0.5" effort="10"/>
  </joint>
  <joint name="fixture" type="fixed">
    <origin xyz="0 0.1 0" rpy="0 0 0.5"/><parent link="trolley"/><child link="boom"/>
  </joint>
  <joint name="luff" type="revolute">
    <origin xyz="0.3 0 0"/><parent link="boom"/><child link="hook"/><axis xyz="1 1 0"/>
    <limit lower="-1" upper="1" velocity="2" effort="5"/>
    <safety_controller soft_lower_limit="-0.8" soft_upper_limit="0.9" k_velocity="1"/>
  </joint>
  <joint name="grip" type="prismatic">
    <parent link="hook"/><child link="finger"/><limit lower="0" upper="1" velocity="1" effort="1"/><mimic joint="luff"/>
  </joint>
  <joint name="slide" type="planar"><parent link="hook"/><child link="puck"/></joint>
  <joint name="side" type="revolute">
    <parent link="mast"/><child link="aside"/><limit lower="0" upper="1" velocity="1" effort="1"/>
  </joint>
</robot>
"""


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


@pytest.fixture
def crane(tmp_path) -> Path:
    """A user's own robot: a tree with every joint type, an axis left to its default, one that is no unit vector."""
    path = tmp_path / "crane.urdf"
    path.write_text(CRANE)
    return path


@pytest.fixture
def random_q():
    """Joint positions inside an arm's soft limits, +- pi where there is none."""

    def draw(arm, count: int, seed: int = 0) -> torch.Tensor:
        lower, upper = arm.limits.soft_lower.clamp(min=-3.14), arm.limits.soft_upper.clamp(max=3.14)
        unit = torch.rand(count, len(lower), generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        return lower + unit * (upper - lower)

    return draw
