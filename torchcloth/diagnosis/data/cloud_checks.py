"""Checks of point clouds against the cloth and the grippers: size, place, handedness."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment

from ...boundaries import Grasp
from ...cloth import Cloth
from ...episodes.recorded_cloth import build_cloth, compute_initial_vertices
from ...losses import find_closest_points
from ...recordings import Recording, size_checks
from ...robots import replay  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation
from ...robots.paths import GripperPath, holding_paths  # pyright: ignore[reportMissingImports]
from ...types import Trajectory

MAX_INITIAL_OFFSET_M = 0.1  # median distance of the first points from the initial shape
MAX_STRAY_FRACTION = 0.1  # of the points, out of reach of a gripper
MAX_REACH_LENGTHS = 1.1  # distance of the cloth from a gripper that holds it, in lengths of the cloth
MAX_GRASP_OFFSET_M = 0.05  # mean distance of grasped vertices from their grippers
SWAP_IMPROVEMENT = 0.5  # factor by which swapped grippers must reduce that distance
MAX_FOLLOW_ERROR_M = 0.06  # change of the cloud's distance from the grippers
MIRROR_IMPROVEMENT = 0.4  # factor by which a mirrored cloud must reduce an error
MIN_MIRRORED_MOTION = 0.5  # motion of the grippers that a mirror turns around, as a fraction of that change
NEAREST_POINTS = 5  # points whose mean distance from a gripper is used
INITIAL_FRAMES = 3  # frames that show the initial shape


class CheckedEpisode:
    """One episode as the checks look at it."""

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        stream = recording.points if recording.points is not None else recording.markers
        self.t = np.zeros(0) if stream is None else stream.t + recording.clock_offset
        self.clouds = size_checks.sample_frames(recording)
        self.paths: dict[str, GripperPath] = holding_paths(recording)

    @cached_property
    def cloth(self) -> Cloth:
        """The cloth as the episode describes it."""
        return build_cloth(self.recording)

    @cached_property
    def initial(self) -> torch.Tensor:
        """[V, 3] initial shape [m]."""
        return compute_initial_vertices("episode", self.cloth, self.recording).double()

    @cached_property
    def length(self) -> float:
        """Length of the cloth from corner to corner [m]."""
        return size_checks.cloth_size(self.recording.cloth)[0] or float(
            size_checks.cloud_diameter(self.initial.numpy())
        )

    def measure_initial_offset(self, clouds: Sequence[np.ndarray]) -> float:
        """Return the median distance of the first points from the initial shape [m]."""
        points = torch.as_tensor(np.concatenate(clouds[:INITIAL_FRAMES])).to(self.initial)
        projected = find_closest_points(points, self.initial, torch.as_tensor(self.cloth.mesh.faces)).interpolate(
            self.initial
        )
        return float((points - projected).norm(dim=-1).median())

    def measure_follow_error(self, clouds: Sequence[np.ndarray]) -> float:
        """Return how much the clouds' distance from the grippers changes, as the 90 % quantile over frames [m]."""
        distances = np.array([_mean_nearest(c, at) for c, at in zip(clouds, self.gripper_positions, strict=True)])
        distances = distances[np.isfinite(distances).all(1)]  # frames with points
        return float(np.quantile(np.abs(distances - np.median(distances[:INITIAL_FRAMES], axis=0)).max(1), 0.9))

    def measure_mirrored_motion(self, matrix: np.ndarray) -> float:
        """Return how far a mirror [3, 3] would move the grippers, as the 90 % quantile over frames [m]."""
        moved = self.gripper_positions - self.gripper_positions[0]
        return float(np.quantile(np.linalg.norm(moved @ matrix.T - moved, axis=-1).max(1), 0.9))

    @cached_property
    def gripper_positions(self) -> np.ndarray:
        """[T, G, 3] positions of the grippers [m]."""
        return np.stack([path.at(self.t)[0] for path in self.paths.values()], 1)

    @cached_property
    def gripper_motions(self) -> dict[str, Trajectory]:
        """Trajectories of the grippers by name."""
        return replay(self.recording, names=self.paths)

    @cached_property
    def holding_positions(self) -> np.ndarray:
        """[T, G, 3] positions of the grippers while they hold the cloth [m]; NaN afterwards."""
        out = self.gripper_positions.copy()
        for k, name in enumerate(self.paths):
            motion = self.gripper_motions[name]
            knot = np.searchsorted(motion.t.numpy(), self.t + 1e-9, side="right").clip(min=1) - 1
            out[~motion.closed.numpy()[knot], k] = np.nan
        return out


def _mean_nearest(cloud: np.ndarray, grippers: np.ndarray) -> np.ndarray:
    """Return [G] m, mean distance of the nearest points from each gripper."""
    if not len(cloud):
        return np.full(len(grippers), np.nan)
    distances = np.sort(np.linalg.norm(cloud - grippers[:, None], axis=-1), axis=1)
    return distances[:, :NEAREST_POINTS].mean(1)


def check_units(episode: CheckedEpisode) -> Iterator[tuple[str, str]]:
    """Yield a fault if no cloth of this size could show such a cloud."""
    if (
        fault := size_checks.detect_wrong_unit(size_checks.select_sized_clouds(episode.clouds), episode.length)
    ) is not None:
        yield fault


def check_positions(episode: CheckedEpisode) -> Iterator[tuple[str, str]]:
    """Yield faults if grippers, cloth and cloud are not where each other says."""
    yield from _check_swapped_grippers(episode)
    if not any(len(c) for c in episode.clouds[:INITIAL_FRAMES]):
        return
    if (offset := episode.measure_initial_offset(episode.clouds)) > MAX_INITIAL_OFFSET_M:
        how, best = _find_best_mirror(episode, episode.measure_initial_offset, _list_mirrors(episode))
        if best < MIRROR_IMPROVEMENT * offset:
            yield _mirror_fault(how)
        else:
            yield (
                f"the first points lie {offset:.2f} m off the cloth's first shape",
                "check the camera's place (T_world_camera) and cloth.initial_vertices; both are in world coordinates",
            )
        return
    if episode.paths:
        reach = MAX_REACH_LENGTHS * episode.length
        frames = zip(episode.clouds, episode.holding_positions, strict=True)
        stray = np.mean([_fraction_out_of_reach(cloud, grippers, reach) for cloud, grippers in frames])
        if stray > MAX_STRAY_FRACTION:
            yield (
                f"{100 * stray:.0f} % of the points lie farther from a gripper than the cloth reaches",
                "leave out what is no cloth (torchcloth inspect shows it)",
            )


def _fraction_out_of_reach(cloud: np.ndarray, grippers: np.ndarray, reach: float) -> float:
    if not len(cloud):
        return 0.0
    return float((np.linalg.norm(cloud[:, None] - grippers, axis=-1) > reach).any(1).mean())


def _check_swapped_grippers(episode: CheckedEpisode) -> Iterator[tuple[str, str]]:
    grasped = {name: part.index for name, part in episode.cloth.boundaries.items() if isinstance(part, Grasp)}
    names = [name for name in grasped if name in episode.paths]
    if len(names) < 2:
        return
    start = episode.t[:1] if len(episode.t) else np.array([max(p.t[0] for p in episode.paths.values())])
    patches = np.stack([episode.initial[grasped[name]].mean(0).numpy() for name in names])
    grippers = np.stack([episode.paths[name].at(start)[0][0] for name in names])
    distances = np.linalg.norm(patches[:, None] - grippers, axis=-1)
    rows, best = linear_sum_assignment(distances)
    stated, swapped = float(distances.diagonal().mean()), float(distances[rows, best].mean())
    if stated > MAX_GRASP_OFFSET_M and swapped < SWAP_IMPROVEMENT * stated:
        pairs = ", ".join(f"{names[i]} holds what {names[k]} should" for k, i in enumerate(best.tolist()) if i != k)
        yield (
            f"the grippers are swapped: {pairs} ({100 * stated:.0f} cm from its place, {100 * swapped:.0f} cm then)",
            "exchange their names in motion.npz or in grasps",
        )


class Mirror(NamedTuple):
    """Reflection at a plane, or an exchange of two axes.

    Attributes:
        how: description for messages.
        matrix: [3, 3] reflection.
        origin: [3] a point of the plane [m].
    """

    how: str
    matrix: np.ndarray
    origin: np.ndarray

    def apply(self, clouds: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return the mirrored clouds."""
        return [(c - self.origin) @ self.matrix.T + self.origin for c in clouds]


def _find_best_mirror(
    episode: CheckedEpisode, measure: Callable[[list[np.ndarray]], float], mirrors: Iterable[Mirror]
) -> tuple[str, float]:
    """Return (description, error [m]) of the mirror with the smallest error."""
    errors = ((m.how, measure(m.apply(episode.clouds))) for m in mirrors)
    return min(errors, key=lambda pair: pair[1], default=("", np.inf))


def _list_mirrors(episode: CheckedEpisode) -> Iterator[Mirror]:
    """Yield planes through the origin, the cloud and the cameras, and exchanges of two axes."""
    cloud_frame = np.eye(4)
    cloud_frame[:3, 3] = np.concatenate(episode.clouds[:INITIAL_FRAMES]).mean(0)
    frames = [("", np.eye(4)), ("", cloud_frame)]
    frames += [(f" of {name}", c.T_world_camera) for name, c in episode.recording.cameras.items()]
    for of, pose in frames:
        rotation, origin = pose[:3, :3], pose[:3, 3]
        for k, axis in enumerate("xyz"):
            yield Mirror(f"along {axis}{of}", rotation @ np.diag(1.0 - 2.0 * np.eye(3)[k]) @ rotation.T, origin)
    for k, pair in enumerate(("y and z", "z and x", "x and y")):
        order = [0, 1, 2]
        a, b = (k + 1) % 3, (k + 2) % 3
        order[a], order[b] = b, a
        yield Mirror(f"with {pair} exchanged", np.eye(3)[order], np.zeros(3))


def check_handedness(episode: CheckedEpisode) -> Iterator[tuple[str, str]]:
    """Yield a fault if the cloud is mirrored: a symmetric cloth looks the same, but does not follow its grippers.

    If a bar hides the cloth near a gripper, a correct cloud seems not to follow it either. So only mirrors are tried
    that would change the grippers' own motion by as much.
    """
    has_points = [len(c) > 0 for c in episode.clouds]
    if not episode.paths or sum(has_points) <= INITIAL_FRAMES or not any(has_points[:INITIAL_FRAMES]):
        return
    if (error := episode.measure_follow_error(episode.clouds)) > MAX_FOLLOW_ERROR_M:
        min_motion = MIN_MIRRORED_MOTION * error
        mirrors = (m for m in _list_mirrors(episode) if episode.measure_mirrored_motion(m.matrix) > min_motion)

        def measure(clouds: list[np.ndarray]) -> float:
            return max(episode.measure_follow_error(clouds), episode.measure_initial_offset(clouds))

        how, best = _find_best_mirror(episode, measure, mirrors)
        if best < MIRROR_IMPROVEMENT * error:
            yield _mirror_fault(how)


def _mirror_fault(how: str) -> tuple[str, str]:
    return (
        f"the cloud is mirrored {how}: turned back, it lies on the cloth and follows the grippers",
        "check the handedness of the camera's frame and of what made points of its depth (OpenCV: x right, y down)",
    )
