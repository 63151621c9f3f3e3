"""Residual rows of one episode, one kind of data after the other, each with noise of its own.

Rows keep their order and meaning between points of a search.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import torch

from ..._utils.linalg import cross, dot
from ...errors import InvalidInput
from .edges import edge_rows
from .rows import Rows, Scene, joined


class Block(NamedTuple):
    """One kind of data."""

    name: str
    unit: str
    floor: float  # of its noise, unless something better is known
    gate: float  # beyond this and five standard deviations a row does not count
    rows: Callable[[Scene], Rows | None]


def point_rows(scene: Scene) -> Rows | None:
    """Distances of the points from the surface along its normal."""
    parts, moved = [], scene.moved
    for t, hits in scene.hits.items():
        cloud, x = scene.episode.clouds[t], scene.seen.x[t]
        corners = hits.corners.reshape(-1)
        x0, x1, x2 = x[corners].unflatten(0, (-1, 3)).unbind(1)
        normal = cross(x1 - x0, x2 - x0)
        size = dot(normal, normal).sqrt()
        size = torch.where(size > 0, size, torch.inf)  # a triangle without area has no normal
        normal = normal / size
        offset = cloud - hits.on(x)
        value = dot(normal, offset)
        jacobian = None
        if moved is not None:
            picked = moved.x[:, t].index_select(-2, corners).unflatten(-2, (-1, 3))
            jacobian = -dot(normal, (hits.weights.unsqueeze(-1) * picked).sum(-2))
            beyond = hits.beyond.nonzero().squeeze(-1)  # elsewhere the normal's own turn does not matter
            d0, d1, d2 = picked[:, beyond].unbind(-2)
            a, b, beside = (x1 - x0)[beyond], (x2 - x0)[beyond], (offset - value * normal)[beyond]
            turned = cross(d1 - d0, b.expand_as(d0)) + cross(a.expand_as(d0), d2 - d0)
            jacobian[:, beyond] += dot(turned, beside) / size[beyond]
            jacobian = jacobian.squeeze(-1).mT
        frame = torch.full((len(cloud),), t)
        parts.append(Rows(value.squeeze(-1), jacobian, frame, scene.sheet.patches_on(hits.corners, hits.weights)))
    return joined(parts)


def marker_rows(scene: Scene) -> Rows | None:
    """Offsets of the markers from their material points, in x, y and z."""
    episode, moved = scene.episode, scene.moved
    if episode.markers is None or episode.places is None:
        return None
    known = episode.markers.isfinite().all(-1)
    known[0] = False
    value = (episode.markers - episode.places.on(scene.seen.x))[known].reshape(-1)
    jacobian = None
    if moved is not None:
        jacobian = -torch.stack([episode.places.on(d)[known].reshape(-1) for d in moved.x], dim=-1)
    frame, marker = (index.repeat_interleave(3) for index in known.nonzero(as_tuple=True))
    axis = torch.arange(3).repeat(len(value) // 3)
    return Rows(value, jacobian, frame, 3 * marker + axis) if len(value) else None


def _wrench_rows(scene: Scene, first: int) -> Rows | None:
    parts, moved = [], scene.moved
    for i, (name, measured) in enumerate(scene.episode.wrenches.items()):
        wanted = measured[:, first : first + 3]
        known = wanted.isfinite().all(-1)
        known[0] = False
        if not bool(known.any()):
            continue
        value = (wanted - scene.seen.wrench[name][:, first : first + 3])[known].reshape(-1)
        jacobian = None
        if moved is not None:
            jacobian = -moved.wrench[name][:, known, first : first + 3].flatten(1).mT
        axis = torch.arange(3).repeat(len(value) // 3)
        parts.append(Rows(value, jacobian, known.nonzero().squeeze(-1).repeat_interleave(3), 3 * i + axis))
    return joined(parts)


def force_rows(scene: Scene) -> Rows | None:
    """Measured minus simulated force of every gripper, world axes."""
    return _wrench_rows(scene, 0)


def torque_rows(scene: Scene) -> Rows | None:
    """Measured minus simulated moment of every gripper about its origin, world axes."""
    return _wrench_rows(scene, 3)


FAR = 0.02  # m
BLOCKS = (
    Block("points", "m", 1e-6, FAR, point_rows),
    Block("edges", "m", 1e-4, FAR, edge_rows),
    Block("markers", "m", 1e-4, FAR, marker_rows),
    Block("force", "N", 5e-3, float("inf"), force_rows),
    Block("torque", "N m", 5e-4, float("inf"), torque_rows),
)
USES = {"points": ("points", "edges"), "markers": ("markers",), "force": ("force", "torque")}


def blocks_for(uses: Sequence[str] | str | None) -> tuple[Block, ...]:
    """The kinds of data that are used; None: all; a string: that one.

    Raises:
        InvalidInput: a name that is not one of ``USES``.
    """
    uses = [uses] if isinstance(uses, str) else uses
    for use in uses or ():
        if use not in USES:
            raise InvalidInput("use", got=repr(use), expected=f"some of {', '.join(USES)}")
    wanted = [name for use in uses or USES for name in USES[use]]
    return tuple(block for block in BLOCKS if block.name in wanted)


def floors_of(noise: Mapping[str, float] | None) -> dict[str, float]:
    """Least standard deviations as a user gives them, by kind.

    Raises:
        InvalidInput: a kind that is none of ``BLOCKS``, or no positive number.
    """
    names = [block.name for block in BLOCKS]
    for name, std in (noise or {}).items():
        if name not in names:
            raise InvalidInput("noise", got=repr(name), expected=f"some of {', '.join(names)}")
        if not 0 < std < float("inf"):
            raise InvalidInput(f"noise of {name}", got=std, expected="a finite standard deviation > 0")
    return dict(noise or {})
