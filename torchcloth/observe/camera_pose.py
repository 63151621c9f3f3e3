"""The pose of a camera from an arm in its view: depth images are laid on the arm's solids.

Pixels that see the arm give one equation each: the measured point lies in the plane of the rendered one. Unknown are
the camera's pose and what else shifts these points: the arm's joints and clock, the scale and a smooth bias of the
depth, and the size of the solids. The latter have priors, so that the errors of the pose count them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ..errors import InvalidInput
from .camera import DepthCamera
from .camera_pose_search import find_moving_points, search_starts
from .noise import mask_depth_edges
from .render import render_surfaces
from .solids import Solid, build_solid_meshes

Array = np.ndarray
MAX_PIXELS = (25_000, 7_000)  # of an image, and of one in the search; larger ones are read with a stride
GATES_M = tuple(np.geomspace(0.20, 0.03, 9))  # farthest point that counts, one for each coarse iteration
FIRST_ITERATIONS = 5  # from every start, with every second image
MAX_REFINED_STARTS = 2
SCORE_GATE_M = 0.02
GATE_STDS = 4.685  # of the points' distances, in the fine iterations: 95 % efficient for normal errors (Tukey)
FINE_GATE_RANGE_M = (0.004, 0.04)
MAX_NUISANCE_STDS = 6.0  # of what else shifts the points; a pose that needs more is wrong
FINE_ITERATIONS = 12
CONVERGED_STEP = 1e-5  # m and rad
MIN_FACING_COSINE = 0.25  # pixels that see a surface more obliquely say little
MAX_DEPTH_STEP_M = 0.03  # pixels on larger steps in depth are left out
BIAS_KNOTS = (4, 8, 16)  # across the image: lengths over which the bias of a depth camera varies
BIAS_STD_FACTORS = (1.0, 1.0, 0.5)  # of the standard deviations of the parts with these lengths
MIN_ARM_PIXELS = 150  # in all images together
MIN_EXPLAINED_FRACTION = 0.6  # of the pixels where the arm should be
AMBIGUITY_RATIO = 0.9  # of the score of the best pose, above which another one is as likely
AMBIGUOUS_TURN_RAD = 0.1
MAX_POSITION_STD_M = 0.03  # a pose with larger standard errors is not determined
MAX_ROTATION_STD_RAD = 0.03
TILES_ACROSS = 24  # of the image
CLUSTER_MIN_POINTS = 20  # of a patch or tile from which the correlation of errors is estimated
MAD_TO_STD = 1.4826
MIN_POINT_STD_M = 0.5e-3  # no depth camera is better


@dataclass(frozen=True, kw_only=True)
class CameraPosePriors:
    """Standard deviations of what shifts an arm's points, before the fit.

    Attributes:
        depth_scale: relative; a RealSense D435 out of the box was 1.9 % off (``StereoNoise.d435``).
        depth_bias: m, of a bias that varies smoothly over the image: the maker's bound of an Azure Kinect, and 0.1 px
            of disparity of a D435 at 1.5 m.
        solid_size: m, by how much each solid's surface lies outside of where it is described.
    """

    depth_scale: float = 0.02
    depth_bias: float = 0.010
    solid_size: float = 0.002

    def __post_init__(self) -> None:
        for name in ("depth_scale", "depth_bias", "solid_size"):
            if not 0 < getattr(self, name) < np.inf:
                raise InvalidInput(name, got=getattr(self, name), expected="a finite number > 0")


@dataclass(frozen=True, eq=False)
class CameraPose:
    """A camera's pose from an arm in its view.

    Attributes:
        T_world_camera: [4, 4] m, camera to world.
        covariance: [6, 6] of the camera's position (m) and of a small rotation (rad), both along the world's axes.
        arm: [P] the arm's unknowns.
        arm_std: [P] their standard errors.
        depth_scale: by which measured depths are multiplied.
        rms: m, root mean square distance of the arm's points from its solids.
        pixels: number of pixels that see the arm, in all images together.
        explained: share of the pixels where the arm should be whose depth is the arm's; cloth hides others.
    """

    T_world_camera: Array
    covariance: Array
    arm: Array
    arm_std: Array
    depth_scale: float
    rms: float
    pixels: int
    explained: float

    @property
    def position_std(self) -> Array:
        """Standard errors [3] m of the position along the world's axes."""
        return np.sqrt(np.diag(self.covariance)[:3])

    @property
    def rotation_std(self) -> Array:
        """Standard errors [3] rad of the rotation about the world's axes."""
        return np.sqrt(np.diag(self.covariance)[3:])

    @property
    def is_determined(self) -> bool:
        """Whether the standard errors are below 30 mm and 0.03 rad."""
        return bool(self.position_std.max() < MAX_POSITION_STD_M and self.rotation_std.max() < MAX_ROTATION_STD_RAD)

    def compare(self, T_world_camera: Array) -> Array:
        """Return how far [6] a pose [4, 4] lies from this one: position (m) and rotation vector (rad), world axes."""
        turn = Rotation.from_matrix(T_world_camera[:3, :3] @ self.T_world_camera[:3, :3].T)
        return np.concatenate([T_world_camera[:3, 3] - self.T_world_camera[:3, 3], turn.as_rotvec()])


def find_camera_pose(
    camera: DepthCamera,
    depths: Array,
    arm: Callable[[Array], Sequence[Solid]],
    arm_std: Array,
    *,
    start: Array | None = None,
    priors: CameraPosePriors | None = None,
) -> CameraPose:
    """Find the pose of a camera that does not move from an arm in its view.

    Starts are searched by what moves in the images, so that none need be given. Cloth, table and room may be in view:
    only points near the arm's surface count.

    Args:
        camera: intrinsics and lens; its pose does not count.
        depths: [T, H, W] m, 0 = invalid; 6 to 20 postures that differ are enough.
        arm: returns the solids with poses [T, 4, 4] at the images, for values [P] of the arm's unknowns (for example a
            lag of the clock and offsets of joints); at zeros, as they were recorded.
        arm_std: [P] standard deviations of these unknowns.
        start: [4, 4] a rough pose, also tried.
        priors: of the camera's depth and of the solids.

    Raises:
        InvalidInput: no arm in view, too little motion of it, or several poses that fit equally well.
        MissingDependency: open3d cannot be imported.
    """
    problem, coarse = (
        _Problem.build(camera, np.asarray(depths), arm, np.asarray(arm_std, float), priors or CameraPosePriors(), count)
        for count in MAX_PIXELS
    )
    solids = arm(np.zeros(len(problem.arm_std)))
    if not solids:
        raise InvalidInput("arm", got="no solids", expected="solids of the links", remedy="add them to its URDF")
    clouds = find_moving_points(coarse.camera, coarse.depths)
    starts = [_Estimate(T, np.zeros(problem.size)) for T in search_starts(clouds, solids, start)]
    starts = _refine(coarse._replace(images=coarse.images[::2]), starts, GATES_M[:FIRST_ITERATIONS])
    candidates = _refine(problem, starts[:MAX_REFINED_STARTS], GATES_M[FIRST_ITERATIONS:])
    best, best_score = candidates[0], _score(problem, candidates[0])
    for other in candidates[1:]:
        score = _score(problem, other)
        turn = Rotation.from_matrix(best.T[:3, :3].T @ other.T[:3, :3]).magnitude()
        if score > AMBIGUITY_RATIO * best_score > 0 and turn > AMBIGUOUS_TURN_RAD:
            raise InvalidInput(
                "camera pose from the arm",
                got=f"two poses {np.rad2deg(turn):.0f} degrees apart that explain the images equally well",
                expected="one",
                remedy="record more postures of the arm, or give a rough pose",
            )
    return _finish(problem, best)


class _Estimate(NamedTuple):
    """Pose and nuisances: arm [P], scale [1], bias [K], sizes [S]."""

    T: Array
    nuisances: Array


class _Problem(NamedTuple):
    camera: DepthCamera
    depths: Array
    arm: Callable[[Array], Sequence[Solid]]
    arm_std: Array
    nuisance_std: Array
    rays: Array
    bias_basis: Array
    tiles: Array
    images: range

    @property
    def size(self) -> int:
        return len(self.nuisance_std)

    @classmethod
    def build(
        cls,
        camera: DepthCamera,
        depths: Array,
        arm: Callable[[Array], Sequence[Solid]],
        arm_std: Array,
        priors: CameraPosePriors,
        max_pixels: int,
    ) -> _Problem:
        """Check the images, leave out flying pixels, and thin large images by a stride."""
        if depths.ndim != 3 or depths.shape[1:] != (camera.height, camera.width) or depths.dtype.kind != "f":
            expected = f"[T, {camera.height}, {camera.width}] in metres"
            raise InvalidInput("depths", got=f"{depths.dtype} {depths.shape}", expected=expected)
        depths = np.where(np.isfinite(depths), depths, 0)
        steep = np.stack([mask_depth_edges(depth, MAX_DEPTH_STEP_M) for depth in depths])
        stride = max(1, int(np.ceil(np.sqrt(camera.height * camera.width / max_pixels))))
        depths = np.where(steep, 0, depths)[:, ::stride, ::stride]
        height, width = depths.shape[1:]
        K = camera.K / [[stride], [stride], [1]]
        thinned = DepthCamera(width, height, K, np.eye(4), camera.range, camera.distortion)
        bases = [_bias_basis(height, width, width / knots) for knots in BIAS_KNOTS]
        bias_std = priors.depth_bias * np.repeat(BIAS_STD_FACTORS, [basis.shape[-1] for basis in bases])
        basis = np.concatenate(bases, axis=-1)
        solids = len(arm(np.zeros(len(arm_std))))
        std = np.concatenate([arm_std, [priors.depth_scale], bias_std, np.full(solids, priors.solid_size)])
        rows, columns = np.indices((height, width)) * TILES_ACROSS // width
        tiles = rows * TILES_ACROSS + columns
        return cls(thinned, depths, arm, arm_std, std, thinned.rays()[1], basis, tiles, range(len(depths)))

    def split(self, nuisances: Array) -> tuple[Array, float, Array, Array]:
        first, knots = len(self.arm_std), self.bias_basis.shape[-1]
        arm, scale, bias, sizes = np.split(nuisances, [first, first + 1, first + 1 + knots])
        return arm, float(scale[0]), bias, sizes


def _bias_basis(height: int, width: int, length: float) -> Array:
    """Bilinear functions [H, W, K] of knots ``length`` px apart."""

    def hats(count: int) -> Array:
        knots = np.arange(int(np.ceil((count - 1) / length)) + 1)
        return np.clip(1 - np.abs(np.arange(count)[:, None] / length - knots), 0, 1)

    return np.einsum("ia,jb->ijab", hats(height), hats(width)).reshape(height, width, -1)


class _Equations(NamedTuple):
    """Distances of N points from the arm, and their derivatives."""

    distance: Array  # [N] m
    derivative: Array  # [N, 6 + size]
    clusters: Array  # [N, 2] patch of one solid in one image, and tile of the image at all times
    arm_pixels: int  # that face the camera and have a reading


def _linearise(problem: _Problem, estimate: _Estimate, gate: float) -> _Equations:
    """Render the arm, and compare it with the points within a gate [m]."""
    arm_values, scale, bias, sizes = problem.split(estimate.nuisances)
    R, origin = estimate.T[:3, :3], estimate.T[:3, 3]
    solids = problem.arm(arm_values)
    motions = _arm_motions(problem, arm_values, solids)
    parts, clusters, arm_pixels = [], [], 0
    for t in problem.images:
        # In the camera's axes, so that the rays stay the same.
        meshes = [((x - origin) @ R, faces) for x, faces in build_solid_meshes(solids, at=t)]
        surface = render_surfaces(problem.camera, meshes)
        pixels = (problem.depths[t] > 0) & (surface.depth > 0)
        ids, measured, rendered = surface.ids[pixels], problem.depths[t][pixels], surface.depth[pixels].astype(float)
        ray, basis = problem.rays[pixels], problem.bias_basis[pixels]
        normal = surface.normals[pixels] * -np.sign((surface.normals[pixels] * ray).sum(1))[:, None]
        slant = (normal * ray).sum(1)  # change of distance by depth, negative: normals point towards the camera
        corrected = (1 + scale) * measured + basis @ bias
        is_facing = slant < -MIN_FACING_COSINE * np.linalg.norm(ray, axis=1)
        arm_pixels += int(is_facing.sum())
        value = slant * (corrected - rendered) - sizes[ids]
        used = is_facing & (np.abs(value) < gate)
        ids, slant, normal = ids[used], slant[used], normal[used] @ R.T
        point = (ray[used] * corrected[used, None]) @ R.T  # from the camera, in the world's axes
        shifts = [  # of the surface with its normal, at the measured point
            np.einsum("nij,nj->ni", motion[ids, t, :3, :3], origin + point) + motion[ids, t, :3, 3]
            for motion in motions
        ]
        derivative = [
            normal,
            np.cross(point, normal),
            *(-(normal * shift).sum(1) for shift in shifts),
            slant * measured[used],
            slant[:, None] * basis[used],
            -np.eye(len(sizes))[ids],
        ]
        parts.append(np.column_stack([value[used], *derivative]))
        clusters.append(np.stack([t * len(solids) + ids, problem.tiles[pixels][used]], axis=1))
    rows = np.concatenate(parts)
    return _Equations(rows[:, 0], rows[:, 1:], np.concatenate(clusters), arm_pixels)


def _arm_motions(problem: _Problem, values: Array, solids: Sequence[Solid]) -> list[Array]:
    """Derivatives [S, T, 4, 4] of where the solids' points are in the world, by each of the arm's unknowns."""

    def poses(solids: Sequence[Solid]) -> Array:
        return np.stack([np.asarray(solid.pose, dtype=float) for solid in solids])

    inverse, motions = np.linalg.inv(poses(solids)), []
    for k, std in enumerate(problem.arm_std):
        step = 0.1 * std * np.eye(len(values))[k]
        ahead, behind = (poses(problem.arm(values + sign * step)) for sign in (1, -1))
        motions.append((ahead - behind) / (0.2 * std) @ inverse)
    return motions


def _improve(problem: _Problem, estimate: _Estimate, gate: float) -> tuple[_Estimate, _Equations, Array, float, float]:
    """Make a Gauss-Newton step; return the estimate, equations, their weights, standard deviation and step size."""
    equations = _linearise(problem, estimate, gate)
    distance, derivative = equations.distance, equations.derivative
    weight = (1 - (distance / gate) ** 2) ** 2  # Tukey's
    std = max(MAD_TO_STD * float(np.median(np.abs(distance))), MIN_POINT_STD_M) if len(distance) else gate
    prior = np.concatenate([np.zeros(6), problem.nuisance_std**-2.0])
    hessian = (derivative.T * weight) @ derivative / std**2 + np.diag(prior)
    values = np.concatenate([np.zeros(6), estimate.nuisances])
    gradient = (derivative.T * weight) @ distance / std**2 + prior * values
    ridge = np.diag(np.concatenate([np.full(6, 1e-2), np.zeros(problem.size)]))  # where no point is near
    step = -np.linalg.solve(hessian + ridge, gradient)
    T = estimate.T.copy()
    T[:3, 3] += step[:3]
    T[:3, :3] = Rotation.from_rotvec(step[3:6]).as_matrix() @ T[:3, :3]
    moved = _Estimate(T, estimate.nuisances + step[6:])
    return moved, equations, weight, std, float(np.abs(step[:6]).max())


def _refine(problem: _Problem, estimates: Sequence[_Estimate], gates: Sequence[float]) -> list[_Estimate]:
    """Make a step at each gate from every estimate; return the results, the best first."""
    refined = []
    for estimate in estimates:
        for gate in gates:
            estimate, *_ = _improve(problem, estimate, gate)
        refined.append(estimate)
    return sorted(refined, key=lambda estimate: -_score(problem, estimate))


def _score(problem: _Problem, estimate: _Estimate) -> float:
    """Number of pixels at the arm's depth, less the number of others where it should be."""
    equations = _linearise(problem, estimate, SCORE_GATE_M)
    return 2.0 * len(equations.distance) - equations.arm_pixels


def _finish(problem: _Problem, estimate: _Estimate) -> CameraPose:
    gate = GATES_M[-1]
    for _ in range(FINE_ITERATIONS):
        estimate, equations, weight, std, step = _improve(problem, estimate, gate)
        gate = float(np.clip(GATE_STDS * std, *FINE_GATE_RANGE_M))
        if step < CONVERGED_STEP:
            break
    count, explained = len(equations.distance), len(equations.distance) / max(equations.arm_pixels, 1)
    if count < MIN_ARM_PIXELS or explained < MIN_EXPLAINED_FRACTION:
        few = f"{count} pixels that see it"
        raise InvalidInput(
            "camera pose from the arm",
            got=few if count < MIN_ARM_PIXELS else f"{explained:.0%} of the arm where it should be",
            expected=f"at least {MIN_ARM_PIXELS} pixels and {MIN_EXPLAINED_FRACTION:.0%}",
            remedy="let the camera see more of the arm, record more postures, or give a rough pose",
        )
    strangest = float(np.abs(estimate.nuisances / problem.nuisance_std).max())
    if strangest > MAX_NUISANCE_STDS:
        raise InvalidInput(
            "camera pose from the arm",
            got=f"lag, joints, depth or solids that are off by {strangest:.0f} times their standard deviations",
            expected=f"at most {MAX_NUISANCE_STDS:g} times",
            remedy="check the arm's model, base and joints, and the camera's matrix; or give a rough pose",
        )
    prior = np.concatenate([np.zeros(6), problem.nuisance_std**-2.0])
    information = (equations.derivative.T * weight) @ equations.derivative
    covariance = np.linalg.inv(information / (std**2 * _design_effect(equations, weight)) + np.diag(prior))
    arm, scale, *_ = problem.split(estimate.nuisances)
    return CameraPose(
        T_world_camera=estimate.T,
        covariance=covariance[:6, :6],
        arm=arm,
        arm_std=np.sqrt(np.diag(covariance)[6 : 6 + len(arm)]),
        depth_scale=1 + scale,
        rms=float(np.sqrt((weight * equations.distance**2).sum() / weight.sum())),
        pixels=count,
        explained=explained,
    )


def _design_effect(equations: _Equations, weight: Array) -> float:
    """Variance of the mean error of a patch or tile over that of as many independent errors (Kish 1965), at least 1."""
    z = weight * equations.distance
    effects = [1.0]
    for cluster in equations.clusters.T:
        large = np.bincount(cluster) >= CLUSTER_MIN_POINTS
        total, square = np.bincount(cluster, z)[large], np.bincount(cluster, z**2)[large]
        if large.any():
            effects.append(float(total @ total / square.sum()))
    return max(effects)
