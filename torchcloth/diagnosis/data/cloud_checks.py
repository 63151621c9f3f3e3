"""What was seen beside what it should be of: its size, its place, whether it follows the grippers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment

from ...boundaries import Grasp
from ...cloth import Cloth
from ...episodes.observed import build_cloth, compute_initial_vertices
from ...losses import closest
from ...recordings import Recording, size_checks
from ...robots import replay  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation
from ...robots.paths import GripperPath, holding_paths  # pyright: ignore[reportMissingImports]
from ...types import Trajectory

FAR = 0.1  # m, of the first points from the first shape, half of them
STRAY, REACH = 0.1, 1.1  # share of points, and lengths of the cloth from a gripper that holds it
AWAY = 0.05  # m, of held places from their grippers: another order that halves it is the right one
FOLLOW, BETTER = 0.06, 0.4  # m by which the cloud leaves the grippers; share of it that a mirrored cloud leaves
TURNED = 0.5  # of that, by which a mirror must turn the grippers' motions to account for it
NEAREST = 5  # points, whose mean distance from a gripper is looked at
FIRST = 3  # frames


class CheckedEpisode:
    """One episode as the checks look at it."""

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        stream = recording.points if recording.points is not None else recording.markers
        self.t = np.zeros(0) if stream is None else stream.t + recording.clock_offset
        self.clouds = size_checks.seen(recording)
        self.paths: dict[str, GripperPath] = holding_paths(recording)

    @cached_property
    def cloth(self) -> Cloth:
        """As the episode describes it."""
        return build_cloth(self.recording)

    @cached_property
    def first(self) -> torch.Tensor:
        """[V, 3] m, first shape."""
        return compute_initial_vertices("episode", self.cloth, self.recording).double()

    @cached_property
    def length(self) -> float:
        """m, of the cloth from corner to corner."""
        return size_checks.size(self.recording.cloth)[0] or float(size_checks.longest(self.first.numpy()))

    def off(self, clouds: Sequence[np.ndarray]) -> float:
        """m, median distance of the first points from the first shape."""
        points = torch.as_tensor(np.concatenate(clouds[:FIRST])).to(self.first)
        on = closest(points, self.first, torch.as_tensor(self.cloth.mesh.faces)).on(self.first)
        return float((points - on).norm(dim=-1).median())

    def left(self, clouds: Sequence[np.ndarray]) -> float:
        """m by which clouds come to lie farther from the grippers than at first, in the worst tenth of the frames."""
        away = np.array([_nearest(c, at) for c, at in zip(clouds, self.held, strict=True)])
        away = away[np.isfinite(away).all(1)]  # of frames with points
        return float(np.quantile(np.abs(away - np.median(away[:FIRST], axis=0)).max(1), 0.9))

    def turned(self, turn: np.ndarray) -> float:
        """m by which a mirror [3, 3] would turn the grippers' motions, in the farthest tenth of the frames."""
        moved = self.held - self.held[0]
        return float(np.quantile(np.linalg.norm(moved @ turn.T - moved, axis=-1).max(1), 0.9))

    @cached_property
    def held(self) -> np.ndarray:
        """[T, G, 3] m, where the grippers are."""
        return np.stack([path.at(self.t)[0] for path in self.paths.values()], 1)

    @cached_property
    def moved(self) -> dict[str, Trajectory]:
        """How, by name."""
        return replay(self.recording, names=self.paths)

    @cached_property
    def holding(self) -> np.ndarray:
        """The same while they hold; NaN once they have let go."""
        out = self.held.copy()
        for k, name in enumerate(self.paths):
            motion = self.moved[name]
            knot = np.searchsorted(motion.t.numpy(), self.t + 1e-9, side="right").clip(min=1) - 1
            out[~motion.closed.numpy()[knot], k] = np.nan
        return out


def _nearest(cloud: np.ndarray, at: np.ndarray) -> np.ndarray:
    """[G] m, mean distance of the nearest points from each gripper."""
    if not len(cloud):
        return np.full(len(at), np.nan)
    away = np.sort(np.linalg.norm(cloud - at[:, None], axis=-1), axis=1)
    return away[:, :NEAREST].mean(1)


def check_units(seen: CheckedEpisode) -> Iterator[tuple[str, str]]:
    """A cloud that no cloth of this size could show."""
    if (found := size_checks.other_unit(size_checks.full(seen.clouds), seen.length)) is not None:
        yield found


def check_positions(seen: CheckedEpisode) -> Iterator[tuple[str, str]]:
    """Grippers, cloth and cloud that are not where each other says."""
    yield from _swapped(seen)
    if not any(len(c) for c in seen.clouds[:FIRST]):
        return
    if (off := seen.off(seen.clouds)) > FAR:
        how, best = _least(seen, seen.off, _mirrors(seen))
        if best < BETTER * off:
            yield _is_mirrored(how)
        else:
            yield (
                f"the first points lie {off:.2f} m off the cloth's first shape",
                "check the camera's place (T_world_camera) and cloth.initial_vertices; both are in world coordinates",
            )
        return
    if seen.paths:
        stray = np.mean([_beyond(c, at, REACH * seen.length) for c, at in zip(seen.clouds, seen.holding, strict=True)])
        if stray > STRAY:
            yield (
                f"{100 * stray:.0f} % of the points lie farther from a gripper than the cloth reaches",
                "leave out what is no cloth (torchcloth inspect shows it)",
            )


def _beyond(cloud: np.ndarray, at: np.ndarray, reach: float) -> float:
    if not len(cloud):
        return 0.0
    return float((np.linalg.norm(cloud[:, None] - at, axis=-1) > reach).any(1).mean())


def _swapped(seen: CheckedEpisode) -> Iterator[tuple[str, str]]:
    held = {name: part.index for name, part in seen.cloth.boundaries.items() if isinstance(part, Grasp)}
    names = [name for name in held if name in seen.paths]
    if len(names) < 2:
        return
    start = seen.t[:1] if len(seen.t) else np.array([max(p.t[0] for p in seen.paths.values())])
    place = np.stack([seen.first[held[name]].mean(0).numpy() for name in names])
    hands = np.stack([seen.paths[name].at(start)[0][0] for name in names])
    away = np.linalg.norm(place[:, None] - hands, axis=-1)
    rows, best = linear_sum_assignment(away)
    own, then = float(away.diagonal().mean()), float(away[rows, best].mean())
    if own > AWAY and then < 0.5 * own:
        pairs = ", ".join(f"{names[i]} holds what {names[k]} should" for k, i in enumerate(best.tolist()) if i != k)
        yield (
            f"the grippers are swapped: {pairs} ({100 * own:.0f} cm from its place, {100 * then:.0f} cm then)",
            "exchange their names in motion.npz or in grasps",
        )


class Mirror(NamedTuple):
    """At a plane through a place, or two axes exchanged."""

    how: str
    turn: np.ndarray  # [3, 3]
    place: np.ndarray  # [3] m

    def of(self, clouds: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Clouds as they would be if they had been mirrored so."""
        return [(c - self.place) @ self.turn.T + self.place for c in clouds]


def _least(seen: CheckedEpisode, measure: Callable[[list[np.ndarray]], float], mirrors: Iterable[Mirror]) -> tuple[str, float]:
    """The mirror that leaves least of a measure [m], and what it leaves."""
    left = ((m.how, measure(m.of(seen.clouds))) for m in mirrors)
    return min(left, key=lambda pair: pair[1], default=("", np.inf))


def _mirrors(seen: CheckedEpisode) -> Iterator[Mirror]:
    """Planes through the origin, the cloud and the cameras."""
    middle = np.concatenate(seen.clouds[:FIRST]).mean(0)
    frames = [("", np.eye(4)), ("", _at(middle))]
    frames += [(f" of {name}", c.T_world_camera) for name, c in seen.recording.cameras.items()]
    for of, pose in frames:
        turn, place = pose[:3, :3], pose[:3, 3]
        for k, axis in enumerate("xyz"):
            yield Mirror(f"along {axis}{of}", turn @ np.diag(1.0 - 2.0 * np.eye(3)[k]) @ turn.T, place)
    for k, pair in enumerate(("y and z", "z and x", "x and y")):
        order = [0, 1, 2]
        a, b = (k + 1) % 3, (k + 2) % 3
        order[a], order[b] = b, a
        yield Mirror(f"with {pair} exchanged", np.eye(3)[order], np.zeros(3))


def _at(place: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = place
    return pose


def check_handedness(seen: CheckedEpisode) -> Iterator[tuple[str, str]]:
    """A symmetric cloth looks the same in a mirror, but does not follow its grippers there.

    Where a bar hides what is near a gripper, a sound cloud seems not to follow it either: only mirrors that would turn
    the grippers' own motion by as much are asked about.
    """
    full = [len(c) > 0 for c in seen.clouds]
    if not seen.paths or sum(full) <= FIRST or not any(full[:FIRST]):
        return
    if (left := seen.left(seen.clouds)) > FOLLOW:
        mirrors = (m for m in _mirrors(seen) if seen.turned(m.turn) > TURNED * left)
        how, best = _least(seen, lambda clouds: max(seen.left(clouds), seen.off(clouds)), mirrors)
        if best < BETTER * left:
            yield _is_mirrored(how)


def _is_mirrored(how: str) -> tuple[str, str]:
    return (
        f"the cloud is mirrored {how}: turned back, it lies on the cloth and follows the grippers",
        "check the handedness of the camera's frame and of what made points of its depth (OpenCV: x right, y down)",
    )
