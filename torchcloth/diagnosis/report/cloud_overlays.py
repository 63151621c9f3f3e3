"""Measured points and simulated cloth at the moment in which the base model is farthest off."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from ...episodes.observed import Episode
from ...losses import find_closest_points
from ..data.binning import BIN_SECONDS, FORCE_BLOCK, BinnedResiduals
from ..data.dataset import DiagnosisData, Progress
from ..decide.search import SearchResult
from ..inference.episode_simulation import map_parallel

MIN_POINTS = 4  # of a frame that is shown


class CloudOverlay(NamedTuple):
    """One moment of one motion, as the observer sees it.

    Attributes:
        motion: label of the motion.
        time: from the first frame [s].
        points: [N, 3] measured points [m].
        surfaces: [V, 3] cloth [m] by the base model, then by the model with its causes, if it has any.
        distances: [N] distance of the points from each surface [m].
    """

    motion: str
    time: float
    points: Tensor
    surfaces: list[Tensor]
    distances: list[Tensor]


def make_overlays(result: SearchResult, progress: Progress = lambda _: None) -> list[CloudOverlay]:
    """Simulate every episode with positions on the given mesh, and take the moment of the largest residual.

    Args:
        result: the search.
        progress: called once, with the name of this stage.
    """
    data, faces = result.data, result.data.surface.faces
    worlds = [result.start.model.build_world(), *([result.end.model.build_world()] if result.accepted else [])]
    frames = [_find_worst_frame(data, k, bins) for k, bins in enumerate(result.start.linearisation.bins)]
    shown = [(k, frame) for k, frame in enumerate(frames) if frame is not None]
    progress("pictures")
    jobs = [partial(world.simulate_observed, data.episodes[k], data.dt) for k, _ in shown for world in worlds]
    simulated = iter(map_parallel(lambda job: job(), jobs))
    overlays = []
    for k, frame in shown:
        e = data.episodes[k]
        points, surfaces = _measured_points(e, frame), [next(simulated).x[frame] for _ in worlds]
        distances = [(points - find_closest_points(points, x, faces).interpolate(x)).norm(dim=-1) for x in surfaces]
        overlays.append(CloudOverlay(data.motions[k], float(e.times[frame] - e.times[0]), points, surfaces, distances))
    return overlays


def _find_worst_frame(data: DiagnosisData, k: int, bins: BinnedResiduals) -> int | None:
    """Return the frame in the middle of the time window with the largest position residual; None without positions."""
    is_position = bins.block < FORCE_BLOCK
    if not bool(is_position.any()):
        return None
    e, window = data.episodes[k], bins.window[is_position]
    square = torch.zeros(1 + int(window.max())).to(bins.value).index_add(0, window, bins.value[is_position].square())
    middle = (int((square / torch.bincount(window).clamp(min=1)).argmax()) + 0.5) * BIN_SECONDS
    elapsed = (e.times - e.times[0]).tolist()
    candidates = [t for t in range(1, len(elapsed)) if len(_measured_points(e, t)) >= MIN_POINTS]
    return min(candidates, key=lambda t: abs(elapsed[t] - middle), default=None)


def _measured_points(e: Episode, frame: int) -> Tensor:
    """Return [N, 3] m the points of a frame, or the markers if there are no points."""
    if len(e.clouds[frame]) or e.markers is None:
        return e.clouds[frame]
    markers = e.markers[frame]
    return markers[markers.isfinite().all(-1)]
