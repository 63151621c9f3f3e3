"""Residual rows of one episode, one kind of data (block) after the other, each with its own noise.

Rows keep their order and meaning between points of a search.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import torch

from ..._utils.linalg import cross, dot
from ...errors import InvalidInput
from .edges import edge_rows
from .rows import ResidualRows, SimulatedEpisode, concatenate_rows


class Block(NamedTuple):
    """One kind of data.

    Attributes:
        name: public name.
        unit: of its residuals.
        noise_floor: least standard deviation of its noise, unless something better is known.
        outlier_distance: a row beyond this and five standard deviations does not count.
        rows: computes its residuals.
    """

    name: str
    unit: str
    noise_floor: float
    outlier_distance: float
    rows: Callable[[SimulatedEpisode], ResidualRows | None]


def point_rows(scene: SimulatedEpisode) -> ResidualRows | None:
    """Compute distances [m] of the points from the surface, along its normal."""
    parts, derivatives = [], scene.derivatives
    for t, hits in scene.hits.items():
        cloud, x = scene.episode.clouds[t], scene.frames.x[t]
        corners = hits.corners.reshape(-1)
        x0, x1, x2 = x[corners].unflatten(0, (-1, 3)).unbind(1)
        normal = cross(x1 - x0, x2 - x0)
        size = dot(normal, normal).sqrt()
        size = torch.where(size > 0, size, torch.inf)  # a triangle without area has no normal
        normal = normal / size
        offset = cloud - hits.interpolate(x)
        residual = dot(normal, offset)
        jacobian = None
        if derivatives is not None:
            corner_slopes = derivatives.x[:, t].index_select(-2, corners).unflatten(-2, (-1, 3))
            jacobian = -dot(normal, (hits.weights.unsqueeze(-1) * corner_slopes).sum(-2))
            beyond = hits.is_beyond_edge.nonzero().squeeze(-1)  # elsewhere a turn of the normal does not matter
            d0, d1, d2 = corner_slopes[:, beyond].unbind(-2)
            a, b, tangential = (x1 - x0)[beyond], (x2 - x0)[beyond], (offset - residual * normal)[beyond]
            normal_slope = cross(d1 - d0, b.expand_as(d0)) + cross(a.expand_as(d0), d2 - d0)
            jacobian[:, beyond] += dot(normal_slope, tangential) / size[beyond]
            jacobian = jacobian.squeeze(-1).mT
        frame = torch.full((len(cloud),), t)
        error_group = scene.surface.error_groups_at(hits.corners, hits.weights)
        parts.append(ResidualRows(residual.squeeze(-1), jacobian, frame, error_group))
    return concatenate_rows(parts)


def marker_rows(scene: SimulatedEpisode) -> ResidualRows | None:
    """Compute offsets [m] of the markers from their material points, in x, y and z."""
    episode, derivatives = scene.episode, scene.derivatives
    if episode.markers is None or episode.marker_places is None:
        return None
    is_seen = episode.markers.isfinite().all(-1)
    is_seen[0] = False
    residual = (episode.markers - episode.marker_places.interpolate(scene.frames.x))[is_seen].reshape(-1)
    jacobian = None
    if derivatives is not None:
        jacobian = -torch.stack(
            [episode.marker_places.interpolate(d)[is_seen].reshape(-1) for d in derivatives.x], dim=-1
        )
    frame, marker = (index.repeat_interleave(3) for index in is_seen.nonzero(as_tuple=True))
    axis = torch.arange(3).repeat(len(residual) // 3)
    return ResidualRows(residual, jacobian, frame, 3 * marker + axis) if len(residual) else None


def _wrench_rows(scene: SimulatedEpisode, first: int) -> ResidualRows | None:
    parts, derivatives, columns = [], scene.derivatives, slice(first, first + 3)
    for i, (name, wrench) in enumerate(scene.episode.wrenches.items()):
        measured = wrench[:, columns]
        is_measured = measured.isfinite().all(-1)
        is_measured[0] = False
        if not bool(is_measured.any()):
            continue
        residual = (measured - scene.frames.wrench[name][:, columns])[is_measured].reshape(-1)
        jacobian = None
        if derivatives is not None:
            jacobian = -derivatives.wrench[name][:, is_measured, columns].flatten(1).mT
        frame = is_measured.nonzero().squeeze(-1).repeat_interleave(3)
        axis = torch.arange(3).repeat(len(residual) // 3)
        parts.append(ResidualRows(residual, jacobian, frame, 3 * i + axis))
    return concatenate_rows(parts)


def force_rows(scene: SimulatedEpisode) -> ResidualRows | None:
    """Compute measured minus simulated force [N] of every gripper, world axes."""
    return _wrench_rows(scene, 0)


def torque_rows(scene: SimulatedEpisode) -> ResidualRows | None:
    """Compute measured minus simulated torque [N m] of every gripper about its origin, world axes."""
    return _wrench_rows(scene, 3)


OUTLIER_DISTANCE_M = 0.02
RESIDUAL_BLOCKS = (
    Block("points", "m", 1e-6, OUTLIER_DISTANCE_M, point_rows),
    Block("edges", "m", 1e-4, OUTLIER_DISTANCE_M, edge_rows),
    Block("markers", "m", 1e-4, OUTLIER_DISTANCE_M, marker_rows),
    Block("force", "N", 5e-3, float("inf"), force_rows),
    Block("torque", "N m", 5e-4, float("inf"), torque_rows),
)
BLOCKS_BY_DATA_KIND = {"points": ("points", "edges"), "markers": ("markers",), "force": ("force", "torque")}


def select_blocks(uses: Sequence[str] | str | None) -> tuple[Block, ...]:
    """Return the blocks of the named kinds of data; None selects all, a string that one kind.

    Raises:
        InvalidInput: a name that is no key of ``BLOCKS_BY_DATA_KIND``.
    """
    uses = [uses] if isinstance(uses, str) else uses
    for use in uses or ():
        if use not in BLOCKS_BY_DATA_KIND:
            raise InvalidInput("use", got=repr(use), expected=f"some of {', '.join(BLOCKS_BY_DATA_KIND)}")
    names = [name for use in uses or BLOCKS_BY_DATA_KIND for name in BLOCKS_BY_DATA_KIND[use]]
    return tuple(block for block in RESIDUAL_BLOCKS if block.name in names)


def check_noise_floors(noise: Mapping[str, float] | None) -> dict[str, float]:
    """Check least standard deviations that a user gives by block name, and return them.

    Raises:
        InvalidInput: a name that is no block, or a number that is not positive and finite.
    """
    names = [block.name for block in RESIDUAL_BLOCKS]
    for name, std in (noise or {}).items():
        if name not in names:
            raise InvalidInput("noise", got=repr(name), expected=f"some of {', '.join(names)}")
        if not 0 < std < float("inf"):
            raise InvalidInput(f"noise of {name}", got=std, expected="a finite standard deviation > 0")
    return dict(noise or {})
