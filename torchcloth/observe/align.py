"""The state of a cloth at its first frame: a mesh laid onto a point cloud, rigidly first, then bent to fit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from ..errors import InvalidInput
from ..losses import closest
from ..meshes import Mesh
from .least_squares import Equations, solve
from .rigid import Pose, register
from .shape_prior import ShapePrior

ROUNDS, FINE, REVIEW = 25, 4, 5  # of matching points anew; the last with all points; between looks at what is visible
OUTLINE = (0.06, 0.01)  # m, in the first and last round: rims farther from points count as hidden
POINTS, COARSE, FEWEST = 1000, 250, 20  # that take part, that do so at first, and that are asked for
PAIRS = 400_000  # of rays and triangles per pass
AT_A_TIME = 4_000_000  # distances
LARGEST = 1.2  # extents of the cloth that a cloud may span
IN_FRONT = 1e-3  # m, that something must be nearer to hide a triangle
HUBER = 2.5  # standard deviations beyond which a point counts linearly
GOOD_RMS, WORST_RMS = 1.5, 4.0  # standard deviations of a point: try no other pose, and refuse
WORST_STRAIN, LEAST_COVERAGE = 0.15, 0.3  # -, share of the visible area


@dataclass(frozen=True, eq=False)
class Alignment:
    """A mesh on a cloud.

    Attributes:
        x: [V, 3] m, float64, vertex positions: pass them to ``Cloth.state``, or keep them as ``initial_vertices``.
        pose: [4, 4], the rigid part of the motion from the placement that was given.
        rms: m, root mean square distance of the points from the surface: the sensor's noise where all is well.
        strain: largest strain of an edge.
        coverage: share of the visible area that has points.
    """

    x: Tensor
    pose: Tensor
    rms: float
    strain: float
    coverage: float


def align(
    mesh: Mesh,
    cloud: ArrayLike | Tensor,
    *,
    start: ArrayLike | Tensor | None = None,
    viewpoint: ArrayLike | None = None,
    noise: float = 0.002,
    strain: float = 0.01,
) -> Alignment:
    """Lay a mesh onto a point cloud that shows one side of it.

    The mesh is registered rigidly from many starts, then bent: points pull the nearest visible surface, edges keep
    their length, curvature is small, and layers that lay on each other stay together, so that hidden ones follow. A
    garment that is the same from the front and from behind cannot be told from its mirror image: the pose that turns
    ``start`` least is taken.

    Args:
        mesh: the cloth; its pattern gives the lengths.
        cloud: [N, 3] m, segmented points of one frame.
        start: [V, 3] m, a placement of the vertices in about the right shape; None: ``mesh.vertices``.
        viewpoint: [3] m, where the camera stood; surface that it cannot see takes no points. None: all may take some,
            and layers nearer to each other than the fit is to them may be confused.
        noise: standard deviation of a point [m].
        strain: standard deviation of the strain of an edge.

    Raises:
        InvalidInput: shapes that do not fit; a cloud that the mesh cannot be laid on.
    """
    whole, x = _check(mesh, cloud, start, noise, strain)
    points = whole[torch.randperm(len(whole), generator=torch.Generator().manual_seed(0))[:POINTS]]
    eye = None if viewpoint is None else _eye(viewpoint)
    tried = []
    for pose in register(x, torch.as_tensor(mesh.faces), whole):
        bent = _bend(mesh, pose.of(x), whole, points, eye, noise, strain)
        tried.append(_judge(mesh, bent, pose, whole, points, eye, noise))
        if tried[-1].rms <= GOOD_RMS * noise:
            break
    best = min(tried, key=lambda one: one.rms)
    _refuse_misfit(best, noise)
    return best


def _bend(mesh: Mesh, x: Tensor, cloud: Tensor, points: Tensor, eye: Tensor | None, noise: float, strain: float):
    """Gauss-Newton from ``x`` [V, 3]; points and outline are matched anew every round."""
    prior, faces = ShapePrior(mesh, x, strain), torch.as_tensor(mesh.faces)
    spacing = _spacing(cloud)
    for k, near in enumerate(torch.logspace(np.log10(OUTLINE[0]), np.log10(OUTLINE[1]), ROUNDS).tolist()):
        if k % REVIEW == 0 or k >= ROUNDS - FINE:
            seen = faces[_visible(x, faces, eye)]
        some = points if k >= ROUNDS - FINE else points[:COARSE]
        data = [*_surface(x, some, seen, noise), _outline(x, cloud, seen, spacing + noise, near)]
        x = x + solve([*data, *prior.equations(x)], len(x))
    return x


def _surface(x: Tensor, points: Tensor, faces: Tensor, noise: float) -> list[Equations]:
    """Points lie on the surface: along its normal all of them, and in its plane those beyond its edge."""
    hits = closest(points, x, faces)
    first, second, third = x[hits.corners].unbind(1)
    normal = torch.nn.functional.normalize(torch.linalg.cross(second - first, third - first), dim=-1)
    offset = points - hits.on(x)
    along = (offset * normal).sum(-1)
    beside = (offset - along.unsqueeze(-1) * normal)[hits.beyond]
    size = beside.norm(dim=-1)
    out = []
    for corners, weights, direction, value in (
        (hits.corners, hits.weights, normal, along),
        (hits.corners[hits.beyond], hits.weights[hits.beyond], beside / size.clamp_min(1e-12).unsqueeze(-1), size),
    ):
        z = value / noise
        equations = Equations(corners, weights.unsqueeze(-1) * direction.unsqueeze(1) / noise, z)
        out.append(equations.weighted(HUBER / z.abs().clamp_min(HUBER)))
    return out


def _outline(x: Tensor, cloud: Tensor, faces: Tensor, scatter: float, near: float) -> Equations:
    """The rim of what is visible ends where the cloud ends, within its spacing; far from points it is hidden."""
    sides = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(-1).values
    edges, count = sides.unique(dim=0, return_counts=True)
    rim = edges[count == 1].unique()
    found = [part.min(-1) for part in _distances(x[rim], cloud)]
    distance, nearest = (torch.cat(parts) for parts in zip(*found, strict=True))
    direction = (cloud[nearest] - x[rim]) / distance.clamp_min(1e-12).unsqueeze(-1)
    equations = Equations(rim.unsqueeze(-1), direction.unsqueeze(1) / scatter, (distance / scatter - 1).clamp_min(0))
    return equations.weighted((1 + (distance / near) ** 2) ** -2 * (distance > scatter))


def _spacing(cloud: Tensor) -> float:
    """Median distance [m] of a point to its nearest neighbour."""
    some = cloud[:: max(1, len(cloud) // 500)]
    second = [part.topk(2, largest=False).values[:, 1] for part in _distances(some, cloud)]
    return float(torch.cat(second).median())


def _distances(points: Tensor, cloud: Tensor) -> Iterator[Tensor]:
    """[some, N] m from points to all of the cloud, a few points at a time."""
    return (torch.cdist(some, cloud) for some in points.split(max(1, AT_A_TIME // len(cloud))))


def _visible(x: Tensor, faces: Tensor, eye: Tensor | None) -> Tensor:
    """Indices of the triangles whose centre is seen from ``eye`` [3], with nothing between; all without an eye."""
    if eye is None:
        return torch.arange(len(faces))
    corners = x[faces]
    centre = corners.mean(1)
    hidden = [_blocked(part, corners, eye) for part in centre.split(max(1, PAIRS // len(faces)))]
    return torch.nonzero(~torch.cat(hidden)).squeeze(-1)


def _blocked(targets: Tensor, corners: Tensor, eye: Tensor) -> Tensor:
    """[N] whether a triangle [F, 3, 3] crosses the way from ``eye`` to a target [N, 3] (Moeller and Trumbore 1997)."""
    ray = (targets - eye).unsqueeze(1)
    a, first, second = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = torch.linalg.cross(ray, second.expand(len(targets), -1, -1))
    volume = (p * first).sum(-1)
    volume = torch.where(volume == 0, torch.full_like(volume, torch.inf), volume)
    offset = eye - a
    q = torch.linalg.cross(offset, first)
    u, v, way = (p * offset).sum(-1) / volume, (ray * q).sum(-1) / volume, (second * q).sum(-1) / volume
    short = 1 - IN_FRONT / ray.norm(dim=-1)
    return ((u >= 0) & (v >= 0) & (u + v <= 1) & (way > 0) & (way < short)).any(-1)


def _judge(
    mesh: Mesh, x: Tensor, pose: Pose, cloud: Tensor, points: Tensor, eye: Tensor | None, noise: float
) -> Alignment:
    """The figures of an alignment."""
    faces = torch.as_tensor(mesh.faces)
    visible = _visible(x, faces, eye)
    seen, area = faces[visible], torch.as_tensor(mesh.area)[visible]
    distance = (points - closest(points, x, seen).on(x)).norm(dim=-1)
    nearest = torch.cat([part.amin(-1) for part in _distances(x[seen].mean(1), cloud)])
    near = nearest < 3 * (noise + _spacing(cloud))
    matrix = torch.eye(4, dtype=x.dtype)
    matrix[:3, :3], matrix[:3, 3] = pose
    sides = (x[faces] - x[faces].roll(-1, 1)).norm(dim=-1)
    rest = torch.as_tensor(mesh.rest)
    stretch = sides / (rest - rest.roll(-1, 1)).norm(dim=-1) - 1
    return Alignment(
        x=x,
        pose=matrix,
        rms=float(distance.square().mean().sqrt()),
        strain=float(stretch.abs().max()),
        coverage=float((area * near).sum() / area.sum()),
    )


def _refuse_misfit(found: Alignment, noise: float) -> None:
    """A result that explains the cloud badly is none."""
    faults = []
    if not found.rms <= WORST_RMS * noise:
        faults.append(f"points {found.rms * 1e3:.1f} mm from the surface (at most {WORST_RMS * noise * 1e3:.1f} mm)")
    if not found.strain <= WORST_STRAIN:
        faults.append(f"an edge strained by {found.strain:.2g} (at most {WORST_STRAIN:g})")
    if not found.coverage >= LEAST_COVERAGE:
        faults.append(f"points on {found.coverage:.0%} of the visible area (at least {LEAST_COVERAGE:.0%})")
    if faults:
        raise InvalidInput(
            "cloud",
            got=", ".join(faults),
            expected="points of one side of this cloth",
            remedy="remove points that are not cloth, check units and noise, or give a start in about the right shape",
        )


def _check_size(mesh: Mesh, points: Tensor) -> None:
    """Refuse points (all but a few strays) that span more than the cloth can."""
    span = float((points.quantile(0.98, dim=0) - points.quantile(0.02, dim=0)).norm())
    if span > LARGEST * mesh.extent:
        raise InvalidInput(
            "cloud",
            got=f"points over {span:.3g} m",
            expected=f"at most the cloth's {mesh.extent:.3g} m",
            remedy="remove points that are not cloth, check that the units are metres",
        )


def _eye(viewpoint: ArrayLike) -> Tensor:
    eye = _float64(viewpoint)
    if eye.shape != (3,) or not torch.isfinite(eye).all():
        raise InvalidInput("viewpoint", got=f"shape {tuple(eye.shape)}", expected="finite [3] in metres")
    return eye


def _check(mesh: Mesh, cloud, start, noise: float, strain: float) -> tuple[Tensor, Tensor]:
    """Cloud and start as float64 tensors."""
    points, x = _float64(cloud), _float64(mesh.vertices if start is None else start)
    for name, value in (("cloud", points), ("start", x)):
        if value.ndim != 2 or value.shape[1] != 3 or not torch.isfinite(value).all():
            raise InvalidInput(name, got=f"shape {tuple(value.shape)}", expected="finite [N, 3] in metres")
    if len(x) != len(mesh.vertices):
        raise InvalidInput("start", got=f"{len(x)} rows", expected=f"{len(mesh.vertices)}, one per vertex")
    if len(points) < FEWEST:
        raise InvalidInput("cloud", got=f"{len(points)} points", expected=f"at least {FEWEST}")
    _check_size(mesh, points)
    for name, value in (("noise", noise), ("strain", strain)):
        if not (np.isfinite(value) and value > 0):
            raise InvalidInput(name, got=f"{value:g}", expected="a positive number")
    return points, x


def _float64(value: ArrayLike | Tensor) -> Tensor:
    """On the CPU, without gradients: a state is estimated once, not differentiated through."""
    value = value.detach().cpu() if isinstance(value, Tensor) else np.array(value, dtype=float)
    return torch.as_tensor(value).to(torch.float64)
