"""The state of a cloth at its first frame: a mesh is laid onto a point cloud, rigidly first, then bent to fit."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from ..errors import InvalidInput
from ..losses import find_closest_points
from ..meshes import Mesh
from .least_squares import Equations, expand_to_axes, solve_moves
from .rigid import Pose, register_rigidly
from .shape_prior import ShapePrior
from .surface_equations import surface_equations

MATCHING_ITERATIONS = 25
FULL_CLOUD_ITERATIONS = 4  # the last iterations, which use all points
VISIBILITY_UPDATE_INTERVAL = 5  # iterations between two updates of the visible triangles
OUTLINE_RADIUS_M = (0.06, 0.01)  # in the first and last iteration; parts of the rim farther from points are hidden
MAX_ALIGNMENT_POINTS = 1000
COARSE_ALIGNMENT_POINTS = 250  # in all but the last iterations
MIN_ALIGNMENT_POINTS = 20
MAX_RAY_TRIANGLE_PAIRS = 400_000  # per pass
MAX_DISTANCES_PER_PASS = 4_000_000
MAX_CLOUD_EXTENT_RATIO = 1.2  # extent of a cloud over that of the cloth
MIN_OCCLUDER_GAP_M = 1e-3  # an occluder is nearer to the camera by at least this
GOOD_RMS_RATIO = 1.5  # rms distance over noise, below which no other pose is tried
MAX_RMS_RATIO = 4.0  # rms distance over noise, above which the alignment is refused
MAX_EDGE_STRAIN = 0.15
MIN_COVERAGE = 0.3  # share of the visible area that has points
HELD_PLACE_STD_M = 0.005  # of a place that a robot holds, as the camera sees it
MAX_HELD_DISTANCE_M = 0.06  # of a held vertex from its place, in a pose from which the mesh is bent


@dataclass(frozen=True, eq=False)
class Alignment:
    """A mesh that was laid on a cloud.

    Attributes:
        x: [V, 3] m, float64, vertex positions: pass them to ``Cloth.state``, or store them as ``initial_vertices``.
        pose: [4, 4], the rigid part of the motion from the given placement.
        rms: m, root mean square distance of the points from the surface; about the sensor's noise for a good fit.
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
    held_vertices: Sequence[int] | np.ndarray = (),
) -> Alignment:
    """Lay a mesh onto a point cloud that shows one side of it.

    The mesh is registered rigidly from many starts and then bent. Points pull the nearest visible surface, edges keep
    their length, curvature is small, and layers that lie on each other stay together, so that hidden layers follow. A
    garment that looks the same from the front and from behind cannot be told from its mirror image: the pose that turns
    ``start`` least is taken.

    Args:
        mesh: the cloth; its pattern gives the lengths.
        cloud: [N, 3] m, segmented points of one frame.
        start: [V, 3] m, a placement of the vertices in about the right shape; None: ``mesh.vertices``.
        viewpoint: [3] m, place of the camera; surface that it cannot see takes no points. None: all surface may take
            points, and layers that are nearer to each other than the fit is to them may be confused.
        noise: m, standard deviation of a point.
        strain: standard deviation of the strain of an edge.
        held_vertices: [H], they are at their places in ``start``, to 5 mm. Poses that take them elsewhere are left
            out, and the start itself is tried.

    Raises:
        InvalidInput: shapes that do not fit, or a cloud that the mesh cannot be laid on.
    """
    cloud_points, x = _validate_inputs(mesh, cloud, start, noise, strain)
    points = cloud_points[
        torch.randperm(len(cloud_points), generator=torch.Generator().manual_seed(0))[:MAX_ALIGNMENT_POINTS]
    ]
    eye = None if viewpoint is None else _eye(viewpoint)
    grasped = torch.as_tensor(np.asarray(held_vertices, dtype=np.int64))
    poses = register_rigidly(x, torch.as_tensor(mesh.faces), cloud_points)
    if len(grasped):
        poses = [pose for pose in poses if _measure_move(pose, x[grasped]) <= MAX_HELD_DISTANCE_M]
        poses.append(Pose(torch.eye(3, dtype=x.dtype), x.new_zeros(3)))
    alignments = []
    for pose in poses:
        pull = partial(_grasp_equations, grasped, x[grasped])
        x_bent = _bend(mesh, pose.transform(x), cloud_points, points, eye, noise, strain, pull)
        alignments.append(_measure_alignment(mesh, x_bent, pose, cloud_points, points, eye, noise))
        if alignments[-1].rms <= GOOD_RMS_RATIO * noise:
            break
    best = min(alignments, key=lambda one: one.rms)
    _refuse_misfit(best, noise)
    return best


def _measure_move(pose: Pose, places: Tensor) -> float:
    """Largest distance [m] by which a pose moves places [H, 3] m."""
    return float((pose.transform(places) - places).norm(dim=-1).max())


def _grasp_equations(vertices: Tensor, places: Tensor, x: Tensor) -> list[Equations]:
    """Held vertices [H] are at their places [H, 3] m."""
    weight = x.new_full((len(vertices), 1), 1 / HELD_PLACE_STD_M)
    return expand_to_axes(vertices.unsqueeze(-1), weight, (places - x[vertices]) / HELD_PLACE_STD_M)


def _bend(
    mesh: Mesh,
    x: Tensor,
    cloud: Tensor,
    points: Tensor,
    eye: Tensor | None,
    noise: float,
    strain: float,
    pull: Callable[[Tensor], list[Equations]],
) -> Tensor:
    """Gauss-Newton from ``x`` [V, 3] m; points and outline are matched anew in every iteration."""
    prior, faces = ShapePrior(mesh, x, strain), torch.as_tensor(mesh.faces)
    spacing = _median_spacing(cloud)
    for k, outline_radius in enumerate(
        torch.logspace(np.log10(OUTLINE_RADIUS_M[0]), np.log10(OUTLINE_RADIUS_M[1]), MATCHING_ITERATIONS).tolist()
    ):
        if k % VISIBILITY_UPDATE_INTERVAL == 0 or k >= MATCHING_ITERATIONS - FULL_CLOUD_ITERATIONS:
            visible = faces[_visible_triangles(x, faces, eye)]
        matched = points if k >= MATCHING_ITERATIONS - FULL_CLOUD_ITERATIONS else points[:COARSE_ALIGNMENT_POINTS]
        data = [
            *surface_equations(x, matched, visible, noise),
            _outline_equations(x, cloud, visible, spacing + noise, outline_radius),
        ]
        x = x + solve_moves([*data, *prior.equations(x), *pull(x)], len(x))
    return x


def _outline_equations(x: Tensor, cloud: Tensor, faces: Tensor, scatter: float, near: float) -> Equations:
    """The rim of the visible surface ends where the cloud ends, within its spacing.

    A part of the rim that is far from points is hidden.
    """
    sides = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(-1).values
    edges, count = sides.unique(dim=0, return_counts=True)
    rim = edges[count == 1].unique()
    nearest_points = [part.min(-1) for part in _distances(x[rim], cloud)]
    distance, nearest = (torch.cat(parts) for parts in zip(*nearest_points, strict=True))
    direction = (cloud[nearest] - x[rim]) / distance.clamp_min(1e-12).unsqueeze(-1)
    equations = Equations(rim.unsqueeze(-1), direction.unsqueeze(1) / scatter, (distance / scatter - 1).clamp_min(0))
    return equations.weighted((1 + (distance / near) ** 2) ** -2 * (distance > scatter))


def _median_spacing(cloud: Tensor) -> float:
    """Median distance [m] of a point to its nearest neighbour."""
    sample = cloud[:: max(1, len(cloud) // 500)]
    second = [part.topk(2, largest=False).values[:, 1] for part in _distances(sample, cloud)]
    return float(torch.cat(second).median())


def _distances(points: Tensor, cloud: Tensor) -> Iterator[Tensor]:
    """Distances [n, N] m from points to all of the cloud, n points at a time."""
    return (torch.cdist(part, cloud) for part in points.split(max(1, MAX_DISTANCES_PER_PASS // len(cloud))))


def _visible_triangles(x: Tensor, faces: Tensor, eye: Tensor | None) -> Tensor:
    """Indices of the triangles whose centre is visible from ``eye`` [3]; all of them without an eye."""
    if eye is None:
        return torch.arange(len(faces))
    corners = x[faces]
    centre = corners.mean(1)
    hidden = [_is_occluded(part, corners, eye) for part in centre.split(max(1, MAX_RAY_TRIANGLE_PAIRS // len(faces)))]
    return torch.nonzero(~torch.cat(hidden)).squeeze(-1)


def _is_occluded(targets: Tensor, corners: Tensor, eye: Tensor) -> Tensor:
    """Whether a triangle [F, 3, 3] crosses the line from ``eye`` to each target [N, 3] (Moeller and Trumbore 1997)."""
    ray = (targets - eye).unsqueeze(1)
    a, first, second = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = torch.linalg.cross(ray, second.expand(len(targets), -1, -1))
    volume = (p * first).sum(-1)
    volume = torch.where(volume == 0, torch.full_like(volume, torch.inf), volume)
    offset = eye - a
    q = torch.linalg.cross(offset, first)
    u, v, ray_fraction = (p * offset).sum(-1) / volume, (ray * q).sum(-1) / volume, (second * q).sum(-1) / volume
    max_fraction = 1 - MIN_OCCLUDER_GAP_M / ray.norm(dim=-1)
    return ((u >= 0) & (v >= 0) & (u + v <= 1) & (ray_fraction > 0) & (ray_fraction < max_fraction)).any(-1)


def _measure_alignment(
    mesh: Mesh, x: Tensor, pose: Pose, cloud: Tensor, points: Tensor, eye: Tensor | None, noise: float
) -> Alignment:
    faces = torch.as_tensor(mesh.faces)
    visible = _visible_triangles(x, faces, eye)
    visible_faces, area = faces[visible], torch.as_tensor(mesh.area)[visible]
    distance = (points - find_closest_points(points, x, visible_faces).interpolate(x)).norm(dim=-1)
    nearest = torch.cat([part.amin(-1) for part in _distances(x[visible_faces].mean(1), cloud)])
    is_covered = nearest < 3 * (noise + _median_spacing(cloud))
    matrix = torch.eye(4, dtype=x.dtype)
    matrix[:3, :3], matrix[:3, 3] = pose
    return Alignment(
        x=x,
        pose=matrix,
        rms=float(distance.square().mean().sqrt()),
        strain=float(edge_strain(mesh, x).abs().max()),
        coverage=float((area * is_covered).sum() / area.sum()),
    )


def edge_strain(mesh: Mesh, x: Tensor) -> Tensor:
    """Return the strain [F, 3] of the triangles' edges at positions [V, 3] m."""
    corners, rest = x[torch.as_tensor(mesh.faces)], torch.as_tensor(mesh.rest)
    return (corners - corners.roll(-1, 1)).norm(dim=-1) / (rest - rest.roll(-1, 1)).norm(dim=-1) - 1


def _refuse_misfit(alignment: Alignment, noise: float) -> None:
    """Refuse a result that explains the cloud badly."""
    faults = []
    if not alignment.rms <= MAX_RMS_RATIO * noise:
        faults.append(
            f"points {alignment.rms * 1e3:.1f} mm from the surface (at most {MAX_RMS_RATIO * noise * 1e3:.1f} mm)"
        )
    if not alignment.strain <= MAX_EDGE_STRAIN:
        faults.append(f"an edge strained by {alignment.strain:.2g} (at most {MAX_EDGE_STRAIN:g})")
    if not alignment.coverage >= MIN_COVERAGE:
        faults.append(f"points on {alignment.coverage:.0%} of the visible area (at least {MIN_COVERAGE:.0%})")
    if faults:
        raise InvalidInput(
            "cloud",
            got=", ".join(faults),
            expected="points of one side of this cloth",
            remedy="remove points that are not cloth, check units and noise, or give a start in about the right shape",
        )


def _check_size(mesh: Mesh, points: Tensor) -> None:
    """Refuse points (all but a few outliers) that span more than the cloth can."""
    span = float((points.quantile(0.98, dim=0) - points.quantile(0.02, dim=0)).norm())
    if span > MAX_CLOUD_EXTENT_RATIO * mesh.extent:
        raise InvalidInput(
            "cloud",
            got=f"points over {span:.3g} m",
            expected=f"at most the cloth's {mesh.extent:.3g} m",
            remedy="remove points that are not cloth, check that the units are metres",
        )


def _eye(viewpoint: ArrayLike) -> Tensor:
    eye = _to_float64(viewpoint)
    if eye.shape != (3,) or not torch.isfinite(eye).all():
        raise InvalidInput("viewpoint", got=f"shape {tuple(eye.shape)}", expected="finite [3] in metres")
    return eye


def _validate_inputs(mesh: Mesh, cloud, start, noise: float, strain: float) -> tuple[Tensor, Tensor]:
    """Cloud and start as float64 tensors, checked."""
    points, x = _to_float64(cloud), _to_float64(mesh.vertices if start is None else start)
    for name, value in (("cloud", points), ("start", x)):
        if value.ndim != 2 or value.shape[1] != 3 or not torch.isfinite(value).all():
            raise InvalidInput(name, got=f"shape {tuple(value.shape)}", expected="finite [N, 3] in metres")
    if len(x) != len(mesh.vertices):
        raise InvalidInput("start", got=f"{len(x)} rows", expected=f"{len(mesh.vertices)}, one per vertex")
    if len(points) < MIN_ALIGNMENT_POINTS:
        raise InvalidInput("cloud", got=f"{len(points)} points", expected=f"at least {MIN_ALIGNMENT_POINTS}")
    _check_size(mesh, points)
    for name, value in (("noise", noise), ("strain", strain)):
        if not (np.isfinite(value) and value > 0):
            raise InvalidInput(name, got=f"{value:g}", expected="a positive number")
    return points, x


def _to_float64(value: ArrayLike | Tensor) -> Tensor:
    """A copy on the CPU without gradients: a state is estimated once, not differentiated through."""
    value = value.detach().cpu() if isinstance(value, Tensor) else np.array(value, dtype=float)
    return torch.as_tensor(value).to(torch.float64)
