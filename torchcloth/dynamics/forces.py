"""What acts on the vertices: forces, the air that moves along, and the boundaries."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import torch
from torch import Tensor

from .._utils.linalg import cross, loaded
from ..boundaries import AbstractCollider, Drive
from ..effects import AbstractEffect
from ..errors import InvalidInput
from ..types import ClothState, Memory, Moment, Surface
from .model import Model, assemble

Impulses = dict[str, Tensor]  # name of a driven boundary -> [..., 6] N s, N m s: what it gave the cloth


def added(total: Impulses, more: Impulses) -> Impulses:
    """Impulses of one stretch of time and the next together."""
    return {name: total[name] + value if name in total else value for name, value in more.items()}


def vertex_forces(
    model: Model,
    state: ClothState,
    s: Surface,
    memory: Memory,
    columns: tuple[Tensor, Tensor],
    lost: Tensor | None = None,
) -> Tensor:
    """Internal forces and effects, assembled on the vertices [..., V, 3] N; without what acts in stages."""
    g = model.geometry
    p1, p2 = columns
    second = -g.area * (g.warp[0] * p1 + g.weft[0] * p2)
    third = -g.area * (g.warp[1] * p1 + g.weft[1] * p2)
    first = -(second + third)
    direct = None
    for name, (effect, c) in model.effects.items():
        now = Moment(state.x, state.v, s, model.mass, memory.get(f"effects.{name}"), lost=lost)
        force = force_of(name, effect, c, now)
        if force is None:
            continue
        later = effect.viscous(c, now) if model.stages else None
        if later is not None and effect.acts_on == "triangles":
            raise InvalidInput(f"effect {name!r}", got="viscous forces of triangles", expected='acts_on = "vertices"')
        force = force if later is None else force - later
        if effect.acts_on == "triangles":
            part = force / 3
            first, second, third = first + part, second + part, third + part
        else:
            direct = force if direct is None else direct + force
    total = assemble(g, (first, second, third), state.x)
    return total if direct is None else total + direct


def force_of(name: str, effect: AbstractEffect, c: Any, now: Moment) -> Tensor | None:
    """What an effect gives [..., V or E, 3] N; None: nothing.

    Raises:
        InvalidInput: another shape than it promised.
    """
    force = effect.force(c, now)
    rows = (now.x if effect.acts_on == "vertices" else now.surface.n).shape[-2]
    if force is not None and force.shape[-2:] != (rows, 3):
        expected = f"[..., {rows}, 3], a row for each of the {effect.acts_on}"
        raise InvalidInput(f"force of effect {name!r}", got=f"shape {tuple(force.shape)}", expected=expected)
    return force


def resistance_of(model: Model, s: Surface, x: Tensor) -> Tensor | None:
    """Mass that moves along with the normal only, relative to the vertices' own [..., V, 3, 3]; None without any."""
    found = [effect.inertia(c, s) for effect, c in model.effects.values()]
    triangles = [m for m in found if m is not None]
    if not triangles:
        return None
    share = (sum(triangles) / 3 * s.n).unsqueeze(-1) * s.n.unsqueeze(-2)
    flat = share.flatten(-2)
    total = assemble(model.geometry, (flat, flat, flat), x[..., :1].expand(*x.shape[:-1], 9))
    return (total / model.mass).unflatten(-1, (3, 3))


def constrain(
    model: Model,
    x: Tensor,
    v: Tensor,
    dt: float,
    drives: Mapping[str, Drive],
    substep: int,
    resistance: Tensor | None,
) -> tuple[Tensor, Impulses]:
    """Velocities that obey the boundaries, and what each driven one gave: impulse and its moment about the body."""
    impulses: Impulses = {}
    for name, boundary in model.boundaries.items():
        drive = drives.get(name)
        if isinstance(boundary, AbstractCollider):
            after = boundary.constrain(x, v, dt, drive, substep, resistance, model.mass)
        else:
            after = boundary.constrain(x, v, dt, drive, substep)
        if drive is not None:
            after = _slipped(model, name, v, after, dt, resistance)
            momentum = model.mass * loaded(resistance, after - v)
            arm = x - _origin(drive, substep)
            impulses[name] = torch.cat([momentum.sum(-2), cross(arm, momentum).sum(-2)], dim=-1)
        v = after
    return v, impulses


def _origin(drive: Drive, substep: int) -> Tensor:
    """Where the body's origin is at the start of the substep [..., 1, 3] m; with x there, angular momentum balances."""
    step, end = drive.increment[..., substep, :, :], drive.pose[..., substep, None, :3, 3]
    return (end - step[..., None, :3, 3]) @ step[..., :3, :3]


def _slipped(model: Model, grasp: str, free: Tensor, held: Tensor, dt: float, resistance: Tensor | None) -> Tensor:
    for effect, c in model.effects.values():
        if effect.grasp == grasp:
            index = cast("Tensor", model.boundaries[grasp].index)
            held = effect.loosen(c, index, free, held, model.mass, dt, resistance)
    return held
