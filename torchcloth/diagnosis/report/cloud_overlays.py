"""What was measured over what the models simulate, in the moment in which the base model is farthest off."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from ...episodes.observed import Episode
from ...losses import closest
from ..data.binning import FORCE_BLOCK, BIN_SECONDS, BinnedResiduals
from ..data.dataset import Progress, DiagnosisData
from ..decide.search import SearchResult
from ..inference.episode_simulation import map_parallel

FEWEST = 4  # points of a frame that is shown


class CloudOverlay(NamedTuple):
    """One moment of one motion, as the observer sees it."""

    motion: str
    time: float  # s, from the first frame
    points: Tensor  # [N, 3] m, measured
    surfaces: list[Tensor]  # [V, 3] m by the base model, then with its causes, if it has any
    distances: list[Tensor]  # [N] m, of the points from each


def make_overlays(found: SearchResult, progress: Progress = lambda _: None) -> list[CloudOverlay]:
    """Of every episode in which something was seen, on the given mesh."""
    setting, faces = found.data, found.data.sheet.faces
    worlds = [found.start.model.world(), *([found.end.model.world()] if found.accepted else [])]
    moments = [_farthest(setting, k, cells) for k, cells in enumerate(found.start.linearisation.bins)]
    shown = [(k, frame) for k, frame in enumerate(moments) if frame is not None]
    progress("pictures")
    jobs = [partial(world.frames, setting.episodes[k], setting.dt) for k, _ in shown for world in worlds]
    simulated = iter(map_parallel(lambda job: job(), jobs))
    out = []
    for k, frame in shown:
        e = setting.episodes[k]
        points, sheets = _measured(e, frame), [next(simulated).x[frame] for _ in worlds]
        distances = [(points - closest(points, x, faces).on(x)).norm(dim=-1) for x in sheets]
        out.append(CloudOverlay(setting.motions[k], float(e.times[frame] - e.times[0]), points, sheets, distances))
    return out


def _farthest(setting: DiagnosisData, k: int, cells: BinnedResiduals) -> int | None:
    """The frame in the middle of the stretch of time in which most is left of positions; None: none were seen."""
    seen = cells.block < FORCE_BLOCK
    if not bool(seen.any()):
        return None
    e, window = setting.episodes[k], cells.window[seen]
    left = torch.zeros(1 + int(window.max())).to(cells.value).index_add(0, window, cells.value[seen].square())
    middle = (int((left / torch.bincount(window).clamp(min=1)).argmax()) + 0.5) * BIN_SECONDS
    since = (e.times - e.times[0]).tolist()
    told = [t for t in range(1, len(since)) if len(_measured(e, t)) >= FEWEST]
    return min(told, key=lambda t: abs(since[t] - middle), default=None)


def _measured(e: Episode, frame: int) -> Tensor:
    """[N, 3] m, points, or markers where there are none."""
    if len(e.clouds[frame]) or e.markers is None:
        return e.clouds[frame]
    markers = e.markers[frame]
    return markers[markers.isfinite().all(-1)]
