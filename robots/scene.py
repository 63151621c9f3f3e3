"""Several arms and a table in one world."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor, nn

from torchcloth.errors import InvalidInput
from torchcloth.recordings import RobotInfo
from torchcloth.types import Trajectory

from .arm import Arm, Primitive, load

# UniFolding (xiaoxiaoxh/UniFolding @ cbd0b37), from its calibration files v23: left base y +0.318, right base y -0.315,
# both level and unrotated within 0.6 degrees; the rounded symmetric value is used.
HALF_BASE_SPACING_M = 0.316


class Table(NamedTuple):
    """A table: a block whose upper side is level. The default is UniFolding's, from its settings (same source).

    Attributes:
        x: m, from and to.
        y: m, from and to.
        height: m, of its upper side.
        thickness: m.
    """

    x: tuple[float, float] = (0.20, 1.02)
    y: tuple[float, float] = (-0.82, 0.82)
    height: float = 0.0
    thickness: float = 0.04

    def primitive(self, dtype: torch.dtype = torch.float64) -> Primitive:
        """Return the block, for drawings, cameras and clearance."""
        (x0, x1), (y0, y1) = self.x, self.y
        pose = torch.eye(4, dtype=dtype)
        pose[:3, 3] = torch.tensor([(x0 + x1) / 2, (y0 + y1) / 2, self.height - self.thickness / 2], dtype=dtype)
        return Primitive("box", (x1 - x0, y1 - y0, self.thickness), pose, "table")


class Scene(nn.Module):
    """Arms by name, each at its own ``base``, and optionally a table.

    Args:
        arms: name to arm, e.g. ``{"left": load("rizon4", base=...), "right": ...}``. The names are those of the grasps.
        table: which the arms must touch with nothing but their fingers; None: there is none.
    """

    def __init__(self, arms: Mapping[str, Arm], table: Table | None = None) -> None:
        super().__init__()
        if not arms:
            raise InvalidInput("arms is empty", expected="one arm or more")
        for name, arm in arms.items():
            if not isinstance(name, str) or not name or "." in name or hasattr(nn.ModuleDict, name):
                expected = "a name without dots that is no method of torch's ModuleDict"
                raise InvalidInput("name of an arm", got=repr(name), expected=expected)
            if not isinstance(arm, Arm):
                raise InvalidInput(f"arm {name!r}", got=type(arm).__name__, expected="an Arm, see load")
        if table is not None:
            _check_table(table)
        self.arms = nn.ModuleDict(dict(arms))
        self.table = table

    def __getitem__(self, name: str) -> Arm:
        return cast(Arm, self.arms[name])

    def forward(self, q: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Compute the poses ``[..., 4, 4]`` m by name, from joint positions ``[..., J]`` by name."""
        self._check_names("q", q)
        return {name: self[name](q[name]) for name in self.arms}

    def motion(
        self, q: Mapping[str, Tensor], t: Tensor, closed: Mapping[str, Tensor] | None = None, **options: Any
    ) -> dict[str, Trajectory]:
        """Compute the motions of all arms through waypoints at common times.

        Args:
            q: joint waypoints ``[..., K, J]`` (rad or m) by name.
            t: ``[K]`` s, the times of the waypoints.
            closed: ``[K]`` bool by name; an arm that is not named always holds.
            options: passed to ``Arm.motion``: ``period``, ``stop``, ``check_limits``.
        """
        self._check_names("q", q)
        closed = dict(closed or {})
        if unknown := closed.keys() - self.arms.keys():
            raise InvalidInput("closed names unknown arms", got=sorted(unknown), expected=f"among {list(self.arms)}")
        return {name: self[name].motion(q[name], t, closed.get(name), **options) for name in self.arms}

    def geometry(self, q: Mapping[str, Tensor]) -> list[Primitive]:
        """Return the solids of all arms in the world, at joint positions ``[..., J]`` by name."""
        self._check_names("q", q)
        return [primitive for name in self.arms for primitive in self[name].geometry(q[name])]

    def robot_infos(self) -> dict[str, RobotInfo]:
        """Return what a recording stores about the arms, by name."""
        return {
            name: RobotInfo(self[name].model, self[name].base.detach().double().cpu().numpy(), self[name].frame)
            for name in self.arms
        }

    def _check_names(self, argument: str, given: Mapping[str, Tensor]) -> None:
        names = sorted(given) if isinstance(given, Mapping) else f"a {type(given).__name__}"
        if names != sorted(self.arms):
            raise InvalidInput(f"{argument} names other arms", got=names, expected=f"by name, {list(self.arms)}")


def _check_table(table: Table) -> None:
    """A table without volume or with NaN would collide with nothing."""
    (x0, x1), (y0, y1) = table.x, table.y
    bounded = all(map(math.isfinite, (x0, x1, y0, y1, table.height, table.thickness)))
    if not (bounded and x0 < x1 and y0 < y1 and table.thickness > 0):
        expected = "finite x and y, each from the smaller to the larger, a finite height and a thickness > 0"
        raise InvalidInput("table", got=table, expected=expected)


def bimanual_rig(model: str = "rizon4", frame: str = "tcp_closed", dtype: torch.dtype = torch.float64) -> Scene:
    """Build two arms side by side as in UniFolding's rig: ``left`` at (0, 0.316, 0) m, ``right`` at (0, -0.316, 0) m.

    World: origin midway between the bases, x away from the robots over the table, y to the left arm, z up. The table's
    top is level with the bases, at z = 0. The positions are the rounded calibration of xiaoxiaoxh/UniFolding @ cbd0b37;
    its arms of 2023 very likely had the wrist of ``rizon4_gen2022``.

    Args:
        model: one of ``list_models()`` or the path of a URDF file.
        frame: the link whose pose is computed.
        dtype: of every tensor of the arms.
    """
    arms = {}
    for name, y in (("left", HALF_BASE_SPACING_M), ("right", -HALF_BASE_SPACING_M)):
        base = torch.eye(4, dtype=dtype)
        base[1, 3] = y
        arms[name] = load(model, frame=frame, base=base, dtype=dtype)
    return Scene(arms, Table())
