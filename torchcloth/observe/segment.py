"""From everything that a depth camera saw to the points of the cloth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import InvalidInput
from .camera import DepthCamera
from .cloud import has_reading, spaced, to_points
from .register import check_bytes, steep
from .render import open3d_or_refuse

Array = np.ndarray
Mesh = tuple[Array, Array]
LEVEL = np.cos(np.deg2rad(10.0))  # a table is level to 10 degrees
TRIES, ROUNDS, REFITS = 4, 300, 20  # planes looked at, draws for each, and least squares after them
UNDER = 0.01  # share of the points that may lie under a table
NOISE = 2.5  # times ``flat``, that a table may scatter by
FLANK = 8  # times ``flat`` around a plane, where one looks whether it is the flank of another


@dataclass(frozen=True, eq=False, kw_only=True)
class Segmentation:
    """How cloth points are told from the rest. A stage whose number is None (a length of 0) is left out.

    The stages run in the order of the attributes. Lengths are in m, in the world.

    Attributes:
        edge: pixels whose 3 x 3 neighbourhood spans more than this are dropped (flying pixels); depth images only.
        low, high: [3] corners of the workspace; -inf and inf where a side is open.
        hsv: two corners (hue, saturation, value), each 0 to 1, of the cloth's colours; a hue range may pass through 1,
            as (0.95, ...), (0.05, ...) does for red.
        robot: points nearer than this to the robot's solids are the robot; more where the sensor's bias is larger.
        table: "find", or [4] (a, b, c, d) of the plane a x + b y + c z + d = 0 with unit normal (a, b, c) upwards.
        above: the table is all that lies lower than this over its plane. Give three standard deviations of the sensor
            or more: at 1 m 6 mm suits an Azure Kinect, 15 mm a D435. Cloth lying flatter goes with the table: tell it
            apart by colour instead, and set ``above`` to -0.01.
        flat: distance within which points count as the table's while it is searched for: at least the sensor's standard
            deviation there (8 mm of a D435 at 1.5 m), or the table may be found millimetres off, or not at all.
        neighbours, deviations: a point is an outlier where the mean distance to so many neighbours exceeds the cloud's
            mean by so many standard deviations.
        radius, company: and where fewer than ``company`` others lie within ``radius``.
        gap: clusters are apart where they are farther from each other than this (DBSCAN).
        crowd: a point with so many within ``gap`` is inside a cluster.
        reach: clusters within this of a grasp are cloth; the largest, where no grasp is given.
        spacing: one measured point is kept of each cube with this edge.
        normals: radius of the neighbourhood that gives the normals.
    """

    edge: float | None = 0.03
    low: tuple[float, float, float] | None = None
    high: tuple[float, float, float] | None = None
    hsv: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    robot: float | None = 0.012
    table: str | tuple[float, float, float, float] | None = None
    above: float = 0.006
    flat: float = 0.004
    neighbours: int | None = 20
    deviations: float = 3.0
    radius: float | None = None
    company: int = 5
    gap: float | None = 0.02
    crowd: int = 8
    reach: float = 0.05
    spacing: float | None = None
    normals: float | None = None

    def __post_init__(self) -> None:
        for name in ("edge", "robot", "flat", "radius", "gap", "reach", "spacing", "normals"):
            value, free = getattr(self, name), name not in ("flat", "reach")  # of a stage that is left out by itself
            if value is None and free:
                continue
            if value is None or not 0 <= value < np.inf:
                raise InvalidInput(name, got=value, expected="None or " * free + "a finite number that is not negative")
        if not 0 < self.deviations < np.inf:  # of 0, half of every cloud would be outliers
            raise InvalidInput("deviations", got=self.deviations, expected="a finite number > 0")
        for name in ("neighbours", "company", "crowd"):
            value, free = getattr(self, name), name == "neighbours"
            if value is None and free:
                continue
            if value is None or not (value >= 1 and value == int(value)):
                raise InvalidInput(name, got=value, expected="None or " * free + "a whole number >= 1")
        if not np.isfinite(self.above):
            raise InvalidInput("above", got=self.above, expected="a finite height in m")
        for name, shape in (("low", (3,)), ("high", (3,)), ("hsv", (2, 3))):
            value = getattr(self, name)
            if value is not None and (np.shape(value) != shape or np.isnan(np.asarray(value, float)).any()):
                raise InvalidInput(name, got=value, expected=f"numbers of shape {list(shape)}")
        if self.low is not None and self.high is not None and not bool(np.all(np.less(self.low, self.high))):
            raise InvalidInput("low", got=self.low, expected=f"below high, {self.high}")
        if self.hsv is not None and not (np.min(self.hsv) >= 0 and np.max(self.hsv) <= 1):
            raise InvalidInput("hsv", got=self.hsv, expected="hue, saturation and value from 0 to 1")
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
class Segmented:
    """What is left.

    Attributes:
        points: [N, 3] m.
        kept: [N] which of the points that came in.
        removed: how many each stage took away, in order; stages that were left out are absent. A table that was looked
            for and not found took 0, and ``table`` is None: its points are still there.
        came: how many came in.
        table: [4] (a, b, c, d) of the plane that was removed, or None.
        normals: [N, 3] unit, towards the camera where it is known, or None.
    """

    points: Array
    kept: Array
    removed: dict[str, int]
    came: int
    table: Array | None = None
    normals: Array | None = None


def segment_depth(
    camera: DepthCamera,
    depth: Array,
    how: Segmentation,
    *,
    mask: Array | None = None,
    colors: Array | None = None,
    robot: Sequence[Mesh] = (),
    grasps: Array | None = None,
) -> Segmented:
    """Cloth points of a depth image; see `segment`.

    Args:
        camera: that took it.
        depth: [H, W] m, 0 = invalid.
        how: the stages.
        mask: [H, W] bool, pixels that may be cloth.
        colors: [H, W, 3] uint8, of the same pixels (`colors_at` gives those of another camera).
        robot: meshes of the robot's solids (`solid_meshes`).
        grasps: [G, 3] m, where grippers hold the cloth.

    Raises:
        InvalidInput: an image of another size than the camera's, or a mask or colors of another than the image's.
    """
    depth = np.asarray(depth)
    _check_sizes(camera, depth, mask, colors)
    wanted = has_reading(depth) & np.isfinite(camera.grid[..., 0])
    if mask is not None:
        wanted &= np.asarray(mask, dtype=bool)
    taken = steep(depth, how.edge) & wanted if how.edge else np.zeros_like(wanted)
    left = wanted & ~taken
    points = to_points(camera, depth, left)
    seen = None if colors is None else np.asarray(colors)[left]
    eye = camera.T_world_camera[:3, 3]
    found = segment(points, how, colors=seen, robot=robot, grasps=grasps, viewpoint=eye)
    removed = {"edge": int(taken.sum()), **found.removed} if how.edge else found.removed
    kept = np.flatnonzero(left[wanted])[found.kept]
    return Segmented(found.points, kept, removed, int(wanted.sum()), found.table, found.normals)


def _check_sizes(camera: DepthCamera, depth: Array, mask: Array | None, colors: Array | None) -> None:
    size = (camera.height, camera.width)
    images = {"depth": (depth, size), "mask": (mask, size), "colors": (colors, (*size, 3))}
    for name, (image, shape) in images.items():
        if image is not None and np.shape(image) != shape:
            expected = f"{list(shape)}, the camera's pixels"
            raise InvalidInput(name, got=f"shape {list(np.shape(image))}", expected=expected)


def segment(
    points: Array,
    how: Segmentation,
    *,
    colors: Array | None = None,
    robot: Sequence[Mesh] = (),
    grasps: Array | None = None,
    viewpoint: Array | None = None,
) -> Segmented:
    """Cloth points of a cloud.

    Args:
        points: [N, 3] m, world.
        how: the stages.
        colors: [N, 3] uint8, needed by ``how.hsv``.
        robot: meshes of the robot's solids (`solid_meshes`).
        grasps: [G, 3] m, where grippers hold the cloth.
        viewpoint: [3] m, towards which normals point.

    Raises:
        MissingDependency: open3d cannot be imported.
        InvalidInput: points or grasps that are not [N, 3] and finite, or no colours for ``how.hsv``, or
            colours that are no whole numbers.
    """
    points = np.asarray(points, dtype=float)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise InvalidInput("points", got=f"shape {points.shape}", expected="[N, 3], finite, in m")
    _check_grasps(grasps)
    if how.hsv is not None:
        _check_colors(np.asarray(colors), points.shape)
    cloud = _Cloud(points)
    if how.low is not None or how.high is not None:
        cloud.keep("crop", lambda p, _: _inside(p, how))
    if how.hsv is not None:
        cloud.keep("color", lambda _, index: _of_color(np.asarray(colors)[index], how))
    if how.robot and len(robot):
        cloud.keep("robot", lambda p, _: _distance(p, robot) > (how.robot or 0))
    table = _table(cloud.points, how)
    if table is not None:
        cloud.keep("table", lambda p, _: p @ table[:3] + table[3] > how.above)
    elif how.table is not None:
        cloud.removed["table"] = 0  # looked for, and not found
    if how.neighbours:
        cloud.keep("outliers", lambda p, _: _sparse(p, how))
    if how.radius:
        cloud.keep("lonely", lambda p, _: _accompanied(p, how))
    if how.gap:
        cloud.keep("clusters", lambda p, _: _cluster(p, how, grasps))
    if spacing := how.spacing:
        cloud.keep("thinned", lambda p, _: np.isin(np.arange(len(p)), spaced(p, spacing)))
    normals = _normals(cloud.points, how.normals, viewpoint) if how.normals else None
    return Segmented(cloud.points, cloud.kept, cloud.removed, len(points), table, normals)


def _check_grasps(grasps: Array | None) -> None:
    """The hand of a pose that was lost is nowhere, and no cluster near it."""
    given = np.zeros((0, 3)) if grasps is None else np.asarray(grasps, dtype=float)
    if given.size and (given.ndim != 2 or given.shape[1] != 3 or not np.isfinite(given).all()):
        got = f"shape {given.shape}" if np.isfinite(given).all() else "NaN or infinite places"
        raise InvalidInput("grasps", got=got, expected="[G, 3], finite, in m", remedy="leave out what is not known")


def _check_colors(colors: Array, shape: tuple[int, ...]) -> None:
    if colors.shape != shape:
        got = "none" if colors.dtype == object else f"shape {colors.shape}"
        raise InvalidInput("colors", got=got, expected=f"{shape}, since hsv is given")
    check_bytes("colors", colors)


class _Cloud:
    """The points that are left, and who took the others."""

    def __init__(self, points: Array) -> None:
        self.points, self.kept, self.removed = points, np.arange(len(points)), {}

    def keep(self, stage: str, choose: Any) -> None:
        good = choose(self.points, self.kept) if len(self.points) else np.zeros(0, bool)
        self.removed[stage] = int((~good).sum())
        self.points, self.kept = self.points[good], self.kept[good]


def _inside(points: Array, how: Segmentation) -> Array:
    low, high = -np.inf if how.low is None else how.low, np.inf if how.high is None else how.high
    return np.all((points >= np.asarray(low)) & (points <= np.asarray(high)), axis=1)


def _of_color(colors: Array, how: Segmentation) -> Array:
    from matplotlib.colors import rgb_to_hsv

    low, high = ((0, 0, 0), (1, 1, 1)) if how.hsv is None else how.hsv
    hue, *rest = rgb_to_hsv(colors / 255).T
    good = (hue >= low[0]) & (hue <= high[0]) if low[0] <= high[0] else (hue >= low[0]) | (hue <= high[0])
    for value, least, most in zip(rest, low[1:], high[1:], strict=True):
        good &= (value >= least) & (value <= most)
    return good


def _distance(points: Array, meshes: Sequence[Mesh]) -> Array:
    """[N] m from the nearest of the solids, negative inside; each is a scene of its own, for they overlap."""
    o3d, found = open3d_or_refuse(), np.full(len(points), np.inf, np.float32)
    asked = o3d.core.Tensor(points.astype(np.float32))
    for vertices, faces in meshes:
        scene = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(
            o3d.core.Tensor(np.ascontiguousarray(vertices, np.float32)),
            o3d.core.Tensor(np.ascontiguousarray(faces, np.uint32)),
        )
        found = np.minimum(found, scene.compute_signed_distance(asked).numpy())
    return found


def _table(points: Array, how: Segmentation) -> Array | None:
    """The lowest level plane that holds a fair share of the points and has next to nothing under it."""
    if how.table is None or not isinstance(how.table, str):
        return None if how.table is None else np.asarray(how.table, dtype=float)
    o3d = open3d_or_refuse()
    o3d.utility.random.seed(0)
    left = points
    for _ in range(TRIES):
        if len(left) < max(100, 0.02 * len(points)):
            return None
        plane, inliers = _cloud(left).segment_plane(how.flat, 3, ROUNDS)
        plane = _refined(np.asarray(plane), left, 2 * how.flat)
        height = points @ plane[:3] + plane[3]
        scatter = _scatter(height, how.flat) if plane[2] > LEVEL else None
        if scatter is not None and (height < -max(3 * how.flat, 4 * scatter)).mean() < UNDER:
            return plane
        left = np.delete(left, inliers, axis=0)
    return None


def _scatter(height: Array, flat: float) -> float | None:
    """Standard deviation of the heights about the one plane that there is at 0; None: there is none.

    Noise of a sensor beyond ``flat`` leaves planes in the tails of the true one, above which points become more and
    more; and below one through cloth points become fewer first and then more.
    """
    count = np.bincount(np.clip(np.rint(height / flat), -FLANK - 1, FLANK + 1).astype(int) + FLANK + 1)
    count = np.pad(count, (0, 2 * FLANK + 3 - len(count)))[1:-1].astype(float)
    below, above = count[FLANK::-1], count[FLANK:]  # from the plane on
    more = lambda side: side[1:] > 1.3 * side[:-1] + 3 * np.sqrt(side[:-1] + 1)  # noqa: E731 - than by chance
    rising = more(above)
    if (rising[0] and rising[1]) or more(below).any():
        return None
    near = -height[(height < 0) & (height > -FLANK * flat)]
    scatter = float(1.4826 * np.median(near)) if len(near) else 0.0
    return scatter if scatter < NOISE * flat else None  # folds of cloth scatter more


def _refined(plane: Array, points: Array, band: float) -> Array:
    """Least squares on what lies within ``band`` m of the plane, repeated; the normal points upwards.

    The draws of RANSAC come in another order in every run: from any of its planes this leads to the same one.
    """
    for _ in range(REFITS):
        near = points[np.abs(points @ plane[:3] + plane[3]) < band * np.linalg.norm(plane[:3])]
        if len(near) < 3:
            break
        middle = near.mean(0)
        normal = np.linalg.eigh((near - middle).T @ (near - middle))[1][:, 0]
        plane = np.array([*normal, -normal @ middle])
    return plane * np.sign(plane[2] or 1.0) / np.linalg.norm(plane[:3])


def _sparse(points: Array, how: Segmentation) -> Array:
    _, good = _cloud(points).remove_statistical_outlier(how.neighbours, how.deviations)
    return np.isin(np.arange(len(points)), good)


def _accompanied(points: Array, how: Segmentation) -> Array:
    _, good = _cloud(points).remove_radius_outlier(how.company, how.radius)
    return np.isin(np.arange(len(points)), good)


def _cluster(points: Array, how: Segmentation, grasps: Array | None) -> Array:
    label = np.asarray(_cloud(points).cluster_dbscan(how.gap, how.crowd))
    if (label < 0).all():
        return label >= 0
    if grasps is None or len(grasps) == 0:
        return np.equal(label, np.bincount(label[label >= 0]).argmax())
    near = (np.linalg.norm(points[:, None] - np.asarray(grasps), axis=-1) < how.reach).any(1)
    return np.isin(label, np.unique(label[near & (label >= 0)]))


def _normals(points: Array, radius: float, viewpoint: Array | None) -> Array:
    if len(points) == 0:
        return np.zeros((0, 3))
    o3d = open3d_or_refuse()
    cloud = _cloud(points)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius, 30))
    if viewpoint is not None:
        cloud.orient_normals_towards_camera_location(np.asarray(viewpoint, dtype=float))
    return np.asarray(cloud.normals).reshape(-1, 3)


def _cloud(points: Array) -> Any:
    o3d = open3d_or_refuse()
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
