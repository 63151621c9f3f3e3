"""Segmentation: from everything that a depth camera saw to the points of the cloth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import InvalidInput
from .camera import DepthCamera
from .cloud import has_reading, select_by_spacing, to_points
from .register import check_uint8, mask_steep_pixels
from .render import import_open3d

Array = np.ndarray
Mesh = tuple[Array, Array]
MIN_TABLE_LEVEL_COSINE = np.cos(np.deg2rad(10.0))  # a table is level to 10 degrees
MAX_TABLE_CANDIDATES = 4  # planes that are tried
RANSAC_DRAWS = 300  # of three points, for each plane
ALL_DRAWS = 1.0  # probability that ends the draws: with less, the threads' timing decides where they end
PLANE_REFITS = 20  # least-squares fits after the draws
MIN_PLANE_POINTS = 100
MIN_PLANE_FRACTION = 0.02  # of the points; a plane of fewer is no table
MAX_FRACTION_UNDER_TABLE = 0.01  # of the points
MAX_TABLE_SCATTER_RATIO = 2.5  # standard deviation of a table's points over ``plane_tolerance``
FLANK_BINS = 8  # bins of ``plane_tolerance`` on either side of a plane that show whether it is the flank of another
MAX_NORMAL_NEIGHBOURS = 30


@dataclass(frozen=True, eq=False, kw_only=True)
class Segmentation:
    """Stages that tell cloth points from the rest. A stage whose number is None, or a length of 0, is skipped.

    The stages run in the order of the attributes. Lengths are in m, in the world frame.

    Attributes:
        max_depth_step: pixels whose 3 x 3 neighbourhood spans more than this are dropped (flying pixels); depth images
            only.
        workspace_low: [3], lower corner of the workspace; -inf where a side is open.
        workspace_high: [3], upper corner of the workspace; inf where a side is open.
        hsv_range: two corners (hue, saturation, value), each 0 to 1, of the cloth's colours. A hue range may pass
            through 1, as (0.95, ...), (0.05, ...) does for red.
        robot_margin: points nearer than this to the robot's solids are the robot; use more for a sensor with a larger
            bias.
        table: "find", or [4] (a, b, c, d) of the plane a x + b y + c z + d = 0 with unit normal (a, b, c) upwards.
        table_margin: points lower than this above the table's plane are the table. Use three standard deviations of the
            sensor or more: at 1 m, 6 mm suits an Azure Kinect and 15 mm a D435. Cloth that lies flatter is removed with
            the table; then tell it apart by colour and set ``table_margin`` to -0.01.
        plane_tolerance: points within this distance count as the table's while it is searched for. Use at least the
            sensor's standard deviation there (8 mm of a D435 at 1.5 m), or the table may be found millimetres off, or
            not at all.
        outlier_neighbours: number of nearest neighbours whose mean distance decides whether a point is an outlier.
        outlier_deviations: a point is an outlier if that distance exceeds the cloud's mean by so many standard
            deviations.
        isolation_radius: radius in which a point must have neighbours.
        isolation_neighbours: number of neighbours that it must have.
        cluster_gap: clusters are farther from each other than this (DBSCAN).
        cluster_core_points: a point with so many neighbours within ``cluster_gap`` is inside a cluster.
        grasp_distance: clusters within this of a grasp are cloth; without grasps, the largest cluster is.
        spacing: one measured point is kept of each cube with this edge.
        normal_radius: radius of the neighbourhood from which normals are estimated.
    """

    max_depth_step: float | None = 0.03
    workspace_low: tuple[float, float, float] | None = None
    workspace_high: tuple[float, float, float] | None = None
    hsv_range: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    robot_margin: float | None = 0.012
    table: str | tuple[float, float, float, float] | None = None
    table_margin: float = 0.006
    plane_tolerance: float = 0.004
    outlier_neighbours: int | None = 20
    outlier_deviations: float = 3.0
    isolation_radius: float | None = None
    isolation_neighbours: int = 5
    cluster_gap: float | None = 0.02
    cluster_core_points: int = 8
    grasp_distance: float = 0.05
    spacing: float | None = None
    normal_radius: float | None = None

    def __post_init__(self) -> None:
        optional = ("max_depth_step", "robot_margin", "isolation_radius", "cluster_gap", "spacing", "normal_radius")
        for name in (*optional, "plane_tolerance", "grasp_distance"):
            value, is_optional = getattr(self, name), name in optional
            if value is None and is_optional:
                continue
            if value is None or not 0 <= value < np.inf:
                expected = "None or " * is_optional + "a finite number that is not negative"
                raise InvalidInput(name, got=value, expected=expected)
        if not 0 < self.outlier_deviations < np.inf:  # with 0, half of every cloud would be outliers
            raise InvalidInput("outlier_deviations", got=self.outlier_deviations, expected="a finite number > 0")
        for name in ("outlier_neighbours", "isolation_neighbours", "cluster_core_points"):
            value, is_optional = getattr(self, name), name == "outlier_neighbours"
            if value is None and is_optional:
                continue
            if value is None or not (value >= 1 and value == int(value)):
                raise InvalidInput(name, got=value, expected="None or " * is_optional + "a whole number >= 1")
        if not np.isfinite(self.table_margin):
            raise InvalidInput("table_margin", got=self.table_margin, expected="a finite height in m")
        for name, shape in (("workspace_low", (3,)), ("workspace_high", (3,)), ("hsv_range", (2, 3))):
            value = getattr(self, name)
            if value is not None and (np.shape(value) != shape or np.isnan(np.asarray(value, float)).any()):
                raise InvalidInput(name, got=value, expected=f"numbers of shape {list(shape)}")
        low, high = self.workspace_low, self.workspace_high
        if low is not None and high is not None and not bool(np.all(np.less(low, high))):
            raise InvalidInput("workspace_low", got=low, expected=f"below workspace_high, {high}")
        if self.hsv_range is not None and not (np.min(self.hsv_range) >= 0 and np.max(self.hsv_range) <= 1):
            raise InvalidInput("hsv_range", got=self.hsv_range, expected="hue, saturation and value from 0 to 1")
        if isinstance(self.table, str) and self.table != "find":
            raise InvalidInput("table", got=repr(self.table), expected='"find", a plane (a, b, c, d), or None')
        if self.table is not None and not isinstance(self.table, str):
            plane = np.asarray(self.table, dtype=float)
            if (
                plane.shape != (4,)
                or not np.isfinite(plane).all()
                or not abs(np.linalg.norm(plane[:3]) - 1) < 1e-6
                or not plane[2] > 0
            ):
                expected = "(a, b, c, d) with a unit normal (a, b, c) that points up"
                raise InvalidInput("table", got=self.table, expected=expected)


@dataclass(frozen=True, eq=False)
class SegmentedCloud:
    """The result of a segmentation.

    Attributes:
        points: [N, 3] m, points of the cloth.
        indices: [N], which of the input points these are.
        removed: number of points that each stage removed, in order; skipped stages are absent. If a table was searched
            for and not found, its number is 0 and ``table`` is None: its points are still among the others.
        input_count: number of input points.
        table: [4] (a, b, c, d) of the plane that was removed, or None.
        normals: [N, 3] unit, towards the camera if its place is known, or None.
    """

    points: Array
    indices: Array
    removed: dict[str, int]
    input_count: int
    table: Array | None = None
    normals: Array | None = None


def segment_depth(
    camera: DepthCamera,
    depth: Array,
    stages: Segmentation,
    *,
    mask: Array | None = None,
    colors: Array | None = None,
    robot: Sequence[Mesh] = (),
    grasps: Array | None = None,
) -> SegmentedCloud:
    """Segment the cloth points of a depth image; see ``segment``.

    Args:
        camera: that took the image.
        depth: [H, W] m, 0 = invalid.
        stages: of the segmentation.
        mask: [H, W] bool, pixels that may be cloth.
        colors: [H, W, 3] uint8, of the same pixels (``sample_colors`` gives those of another camera).
        robot: meshes of the robot's solids (``build_solid_meshes``).
        grasps: [G, 3] m, where grippers hold the cloth.

    Raises:
        InvalidInput: the depth image has not the camera's size, or mask or colors have not that of the image.
    """
    depth = np.asarray(depth)
    _check_sizes(camera, depth, mask, colors)
    wanted = has_reading(depth) & np.isfinite(camera.pixel_rays[..., 0])
    if mask is not None:
        wanted &= np.asarray(mask, dtype=bool)
    steep = mask_steep_pixels(depth, stages.max_depth_step) & wanted if stages.max_depth_step else np.zeros_like(wanted)
    candidates = wanted & ~steep
    points = to_points(camera, depth, candidates)
    candidate_colors = None if colors is None else np.asarray(colors)[candidates]
    eye = camera.T_world_camera[:3, 3]
    result = segment(points, stages, colors=candidate_colors, robot=robot, grasps=grasps, viewpoint=eye)
    removed = {"edge": int(steep.sum()), **result.removed} if stages.max_depth_step else result.removed
    indices = np.flatnonzero(candidates[wanted])[result.indices]
    return SegmentedCloud(result.points, indices, removed, int(wanted.sum()), result.table, result.normals)


def _check_sizes(camera: DepthCamera, depth: Array, mask: Array | None, colors: Array | None) -> None:
    size = (camera.height, camera.width)
    images = {"depth": (depth, size), "mask": (mask, size), "colors": (colors, (*size, 3))}
    for name, (image, shape) in images.items():
        if image is not None and np.shape(image) != shape:
            expected = f"{list(shape)}, the camera's pixels"
            raise InvalidInput(name, got=f"shape {list(np.shape(image))}", expected=expected)


def segment(
    points: Array,
    stages: Segmentation,
    *,
    colors: Array | None = None,
    robot: Sequence[Mesh] = (),
    grasps: Array | None = None,
    viewpoint: Array | None = None,
) -> SegmentedCloud:
    """Segment the cloth points of a cloud.

    Args:
        points: [N, 3] m, world.
        stages: of the segmentation.
        colors: [N, 3] uint8, needed by ``stages.hsv_range``.
        robot: meshes of the robot's solids (``build_solid_meshes``).
        grasps: [G, 3] m, where grippers hold the cloth.
        viewpoint: [3] m, towards which normals point.

    Raises:
        MissingDependency: open3d cannot be imported.
        InvalidInput: points or grasps are not [N, 3] and finite, colours are missing for ``stages.hsv_range``, or
            colours are not whole numbers.
    """
    points = np.asarray(points, dtype=float)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise InvalidInput("points", got=f"shape {points.shape}", expected="[N, 3], finite, in m")
    _check_grasps(grasps)
    if stages.hsv_range is not None:
        _check_colors(np.asarray(colors), points.shape)
    cloud = _RemainingPoints(points)
    if stages.workspace_low is not None or stages.workspace_high is not None:
        cloud.keep("crop", lambda p, _: _is_in_workspace(p, stages))
    if stages.hsv_range is not None:
        cloud.keep("color", lambda _, index: _has_color(np.asarray(colors)[index], stages))
    if (margin := stages.robot_margin) and len(robot):
        cloud.keep("robot", lambda p, _: _signed_distance(p, robot, margin) > margin)
    table = _find_table(cloud.points, stages)
    if table is not None:
        cloud.keep("table", lambda p, _: p @ table[:3] + table[3] > stages.table_margin)
    elif stages.table is not None:
        cloud.removed["table"] = 0  # searched for and not found
    if stages.outlier_neighbours:
        cloud.keep("outliers", lambda p, _: _is_no_outlier(p, stages))
    if stages.isolation_radius:
        cloud.keep("isolated", lambda p, _: _has_neighbours(p, stages))
    if stages.cluster_gap:
        cloud.keep("clusters", lambda p, _: _is_in_cloth_cluster(p, stages, grasps))
    if spacing := stages.spacing:
        cloud.keep("thinned", lambda p, _: np.isin(np.arange(len(p)), select_by_spacing(p, spacing)))
    normals = _estimate_normals(cloud.points, stages.normal_radius, viewpoint) if stages.normal_radius else None
    return SegmentedCloud(cloud.points, cloud.indices, cloud.removed, len(points), table, normals)


def _check_grasps(grasps: Array | None) -> None:
    """A grasp of NaN is near no cluster, so its cloth would be lost silently."""
    given = np.zeros((0, 3)) if grasps is None else np.asarray(grasps, dtype=float)
    if given.size and (given.ndim != 2 or given.shape[1] != 3 or not np.isfinite(given).all()):
        got = f"shape {given.shape}" if np.isfinite(given).all() else "NaN or infinite places"
        raise InvalidInput("grasps", got=got, expected="[G, 3], finite, in m", remedy="leave out unknown grasps")


def _check_colors(colors: Array, shape: tuple[int, ...]) -> None:
    if colors.shape != shape:
        got = "none" if colors.dtype == object else f"shape {colors.shape}"
        raise InvalidInput("colors", got=got, expected=f"{shape}, since hsv_range is given")
    check_uint8("colors", colors)


class _RemainingPoints:
    """The points that remain, their indices in the input, and how many each stage removed."""

    def __init__(self, points: Array) -> None:
        self.points, self.indices, self.removed = points, np.arange(len(points)), {}

    def keep(self, stage: str, choose: Any) -> None:
        good = choose(self.points, self.indices) if len(self.points) else np.zeros(0, bool)
        self.removed[stage] = int((~good).sum())
        self.points, self.indices = self.points[good], self.indices[good]


def _is_in_workspace(points: Array, stages: Segmentation) -> Array:
    low, high = (
        -np.inf if stages.workspace_low is None else stages.workspace_low,
        np.inf if stages.workspace_high is None else stages.workspace_high,
    )
    return np.all((points >= np.asarray(low)) & (points <= np.asarray(high)), axis=1)


def _has_color(colors: Array, stages: Segmentation) -> Array:
    from matplotlib.colors import rgb_to_hsv

    low, high = ((0, 0, 0), (1, 1, 1)) if stages.hsv_range is None else stages.hsv_range
    hue, *rest = rgb_to_hsv(colors / 255).T
    good = (hue >= low[0]) & (hue <= high[0]) if low[0] <= high[0] else (hue >= low[0]) | (hue <= high[0])
    for value, smallest, largest in zip(rest, low[1:], high[1:], strict=True):
        good &= (value >= smallest) & (value <= largest)
    return good


def _signed_distance(points: Array, meshes: Sequence[Mesh], limit: float) -> Array:
    """Distance [N] m to the nearest solid, negative inside; inf beyond the limit, where it need not be computed.

    Each solid is a scene of its own, for solids overlap.
    """
    o3d, distance = import_open3d(), np.full(len(points), np.inf, np.float32)
    for vertices, faces in meshes:
        low, high = np.min(vertices, axis=0) - limit, np.max(vertices, axis=0) + limit
        is_near = np.all((points >= low) & (points <= high), axis=1)
        if not is_near.any():
            continue
        scene = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(
            o3d.core.Tensor(np.ascontiguousarray(vertices, np.float32)),
            o3d.core.Tensor(np.ascontiguousarray(faces, np.uint32)),
        )
        queries = o3d.core.Tensor(points[is_near].astype(np.float32))
        distance[is_near] = np.minimum(distance[is_near], scene.compute_signed_distance(queries).numpy())
    return distance


def _find_table(points: Array, stages: Segmentation) -> Array | None:
    """The lowest level plane that holds a fair share of the points and has next to none below it."""
    if stages.table is None or not isinstance(stages.table, str):
        return None if stages.table is None else np.asarray(stages.table, dtype=float)
    o3d = import_open3d()
    o3d.utility.random.seed(0)
    remaining = points
    for _ in range(MAX_TABLE_CANDIDATES):
        if len(remaining) < max(MIN_PLANE_POINTS, MIN_PLANE_FRACTION * len(points)):
            return None
        plane, inliers = _to_open3d(remaining).segment_plane(stages.plane_tolerance, 3, RANSAC_DRAWS, ALL_DRAWS)
        plane = _refine_plane(np.asarray(plane), remaining, 2 * stages.plane_tolerance)
        height = points @ plane[:3] + plane[3]
        scatter = _estimate_scatter(height, stages.plane_tolerance) if plane[2] > MIN_TABLE_LEVEL_COSINE else None
        if (
            scatter is not None
            and (height < -max(3 * stages.plane_tolerance, 4 * scatter)).mean() < MAX_FRACTION_UNDER_TABLE
        ):
            return plane
        remaining = np.delete(remaining, inliers, axis=0)
    return None


def _estimate_scatter(height: Array, tolerance: float) -> float | None:
    """Standard deviation of the heights about a plane at height 0; None if 0 is not the height of a plane.

    Sensor noise beyond ``tolerance`` leaves planes in the tails of the true one, above which points become more
    frequent. Below a plane through cloth, points become less frequent first and then more.
    """
    count = np.bincount(
        np.clip(np.rint(height / tolerance), -FLANK_BINS - 1, FLANK_BINS + 1).astype(int) + FLANK_BINS + 1
    )
    count = np.pad(count, (0, 2 * FLANK_BINS + 3 - len(count)))[1:-1].astype(float)
    below, above = count[FLANK_BINS::-1], count[FLANK_BINS:]  # from the plane on
    rising, falling = (  # away from the plane, by more than chance
        side[1:] > 1.3 * side[:-1] + 3 * np.sqrt(side[:-1] + 1) for side in (above, below)
    )
    if (rising[0] and rising[1]) or falling.any():
        return None
    near = -height[(height < 0) & (height > -FLANK_BINS * tolerance)]
    scatter = float(1.4826 * np.median(near)) if len(near) else 0.0
    return scatter if scatter < MAX_TABLE_SCATTER_RATIO * tolerance else None  # folds of cloth scatter more


def _refine_plane(plane: Array, points: Array, band: float) -> Array:
    """Least squares on the points within ``band`` m of the plane, repeated; the normal points upwards.

    The draws of RANSAC come in another order in every run. From any of its planes this leads to the same one.
    """
    for _ in range(PLANE_REFITS):
        near = points[np.abs(points @ plane[:3] + plane[3]) < band * np.linalg.norm(plane[:3])]
        if len(near) < 3:
            break
        middle = near.mean(0)
        normal = np.linalg.eigh((near - middle).T @ (near - middle))[1][:, 0]
        plane = np.array([*normal, -normal @ middle])
    return plane * np.sign(plane[2] or 1.0) / np.linalg.norm(plane[:3])


def _is_no_outlier(points: Array, stages: Segmentation) -> Array:
    _, good = _to_open3d(points).remove_statistical_outlier(stages.outlier_neighbours, stages.outlier_deviations)
    return np.isin(np.arange(len(points)), good)


def _has_neighbours(points: Array, stages: Segmentation) -> Array:
    _, good = _to_open3d(points).remove_radius_outlier(stages.isolation_neighbours, stages.isolation_radius)
    return np.isin(np.arange(len(points)), good)


def _is_in_cloth_cluster(points: Array, stages: Segmentation, grasps: Array | None) -> Array:
    label = np.asarray(_to_open3d(points).cluster_dbscan(stages.cluster_gap, stages.cluster_core_points))
    if (label < 0).all():
        return label >= 0
    if grasps is None or len(grasps) == 0:
        return np.equal(label, np.bincount(label[label >= 0]).argmax())
    near = (np.linalg.norm(points[:, None] - np.asarray(grasps), axis=-1) < stages.grasp_distance).any(1)
    return np.isin(label, np.unique(label[near & (label >= 0)]))


def _estimate_normals(points: Array, radius: float, viewpoint: Array | None) -> Array:
    if len(points) == 0:
        return np.zeros((0, 3))
    o3d = import_open3d()
    cloud = _to_open3d(points)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius, MAX_NORMAL_NEIGHBOURS))
    if viewpoint is not None:
        cloud.orient_normals_towards_camera_location(np.asarray(viewpoint, dtype=float))
    return np.asarray(cloud.normals).reshape(-1, 3)


def _to_open3d(points: Array) -> Any:
    o3d = import_open3d()
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
