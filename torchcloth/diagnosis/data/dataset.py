"""Episodes as tensors, on the given mesh and on a finer one, with the surface that points are compared with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from ..._utils.caching import LRUCache, bytes_of
from ...episodes.observed import Episode, build_episode, check_is_held
from ...episodes.observed_surface import ObservedSurface, build_surface
from ...episodes.replay import Frames
from ...episodes.world import MAX_CLOCK_DELAY_S, World, WorldModel
from ...errors import InvalidInput
from ...identification.uncertainty.replicates import motion_keys
from ...recordings import Recording
from .binning import BIN_SECONDS, MAX_BINS, EpisodeEvidence
from .fine_mesh import refine_model

MAX_POINTS_PER_FRAME = 8000  # more points cost memory, and means over parts are certain without them
FRAME_CACHE_BYTES = 256 * 2**20  # frames at points to which a search comes back
OBSERVED_SPAN = f"after its first frame and before its last {MAX_CLOCK_DELAY_S:g} s"
Progress = Callable[[str], None]
EpisodeCache = Callable[[Sequence[object], Tensor, Callable[[], EpisodeEvidence]], EpisodeEvidence]
"""Function of a question, a point and the work that answers it; returns the answer."""


def no_cache(question: Sequence[object], point: Tensor, work: Callable[[], EpisodeEvidence]) -> EpisodeEvidence:
    """Compute the answer without storing it."""
    return work()


def label_motions(recordings: Sequence[Recording]) -> list[str]:
    """Return a label of each episode's motion.

    The label is what the episode says its motion is, or the label of the episode that it repeats. An episode that says
    nothing gets a label of its own.
    """
    originals = {r.split.get("replicate_of") for r in recordings} - {None}
    stated, labels = {r.split.get("motion") for r in recordings}, []
    for k, (r, key) in enumerate(zip(recordings, motion_keys(recordings), strict=True)):
        is_original = r.path is not None and r.path.name in originals
        is_stated = is_original or r.split.get("motion") or r.split.get("replicate_of")
        label = f"episode {k}"
        while label in stated:
            label += "'"
        labels.append(str(key) if is_stated else label)
    return labels


def _frame_cache() -> LRUCache[Frames]:
    return LRUCache(FRAME_CACHE_BYTES, lambda f: bytes_of(f.x, f.v, *f.wrench.values(), f.rim_offset))


@dataclass(frozen=True, eq=False)
class DiagnosisData:
    """Episodes as tensors, and the surface that their points are compared with.

    Attributes:
        base: the base model's world.
        recordings: the episodes as they were read.
        episodes: the same as tensors.
        surface: surface with its parts and rim.
        rest_positions: [V, 3] pattern [m].
        dt: substep of the simulations [s]; None: the largest stable one.
        fine_mesh: the same on a mesh twice as fine.
        bifurcating_bins: per episode, keys of bins with a discontinuous response; empty: not searched for yet.
        clock_stds: prior standard deviation of each episode's clock where it was corrected [s]; else None.
        cache: stores finished episodes.
        recent_frames: the most recent simulations.
    """

    base: World
    recordings: tuple[Recording, ...]
    episodes: tuple[Episode, ...]
    surface: ObservedSurface
    rest_positions: Tensor
    dt: float | None = None
    fine_mesh: DiagnosisData | None = None
    bifurcating_bins: tuple[Tensor, ...] = ()
    clock_stds: tuple[float | None, ...] = ()
    cache: EpisodeCache = no_cache
    recent_frames: LRUCache[Frames] = field(default_factory=_frame_cache)

    @property
    def motions(self) -> list[str]:
        """Label of each episode's motion."""
        return label_motions(self.recordings)

    def without_bins(self, keys: Sequence[Tensor]) -> DiagnosisData:
        """Return the data without further bins, whose keys are given per episode."""
        known = self.bifurcating_bins or [k[:0] for k in keys]
        return replace(self, bifurcating_bins=tuple(map(torch.cat, zip(known, keys, strict=True))))


def prepare_data(model: WorldModel, recordings: Sequence[Recording]) -> DiagnosisData:
    """Convert recordings to tensors on the model's mesh, and on a mesh twice as fine.

    Raises:
        InvalidInput: an episode in which nothing is observed, or one that is too long.
        RecordingError: an episode in which nothing holds the cloth.
    """
    return replace(_prepare(model, recordings), fine_mesh=_prepare(*refine_model(model, recordings)))


def _prepare(model: WorldModel, recordings: Sequence[Recording]) -> DiagnosisData:
    cloth = model.base.cloth
    episodes = []
    for recording in recordings:
        check_is_held(recording)
        episode = extend_for_clock(_subsample(build_episode(cloth, recording)))
        _check_informative(episode)
        episodes.append(episode)
    mesh = cloth.mesh
    pattern = torch.as_tensor(mesh.vertices).double()
    if mesh.uv is not None:
        pattern = torch.nn.functional.pad(torch.as_tensor(mesh.uv).double(), (0, 1))
    else:  # the first two axes serve as u and v, so the thinnest comes last
        thin = int((pattern.amax(0) - pattern.amin(0)).argmin())
        pattern = pattern[:, [*(k for k in range(3) if k != thin), thin]]
    return DiagnosisData(model.base, tuple(recordings), tuple(episodes), build_surface(cloth, episodes), pattern)


def _subsample(e: Episode) -> Episode:
    """Keep ``MAX_POINTS_PER_FRAME`` random points of a frame, the same ones every time."""
    generator = torch.Generator().manual_seed(0)

    def draw(cloud: Tensor) -> Tensor:
        if len(cloud) <= MAX_POINTS_PER_FRAME:
            return cloud
        return cloud[torch.randperm(len(cloud), generator=generator)[:MAX_POINTS_PER_FRAME].sort().values]

    return replace(e, clouds=[draw(cloud) for cloud in e.clouds])


def extend_for_clock(e: Episode) -> Episode:
    """Return the episode with frames after the last one, which a late clock sees.

    Observations that a late clock would make after the simulation's end are dropped. A cloth that stood still in these
    frames would be off by millimetres for no physical reason.
    """
    return drop_unsimulated_frames(e.with_lookahead(MAX_CLOCK_DELAY_S))


def _check_informative(e: Episode) -> None:
    """Raise InvalidInput for an episode that is too long, or without observations after the initial frame."""
    duration, max_duration = float(e.times[-1] - e.times[0]), MAX_BINS * BIN_SECONDS
    if duration >= max_duration:
        raise InvalidInput(
            "episode",
            got=f"{e.name} of {duration:.0f} s",
            expected=f"less than {max_duration:.0f} s",
            remedy="cut it into several",
        )
    if not _has_positions(e) and not any(bool(w[1:].isfinite().any()) for w in e.wrenches.values()):
        raise InvalidInput(
            "episode",
            got=f"{e.name}, without points, markers or forces {OBSERVED_SPAN}",
            expected="frames with points, markers or forces",
            remedy="leave it out, or record longer",
        )


def _has_positions(e: Episode) -> bool:
    return any(len(c) for c in e.clouds[1:]) or (e.markers is not None and bool(e.markers[1:].isfinite().any()))


def check_positions_observed(data: DiagnosisData) -> None:
    """Raise InvalidInput if no episode has points or markers: forces alone do not say where the cloth goes."""
    if not any(map(_has_positions, data.episodes)):
        raise InvalidInput(
            "episodes",
            got=f"none with points or markers {OBSERVED_SPAN}",
            expected="at least one with points or markers",
            remedy="record a depth camera or markers (docs/reference/episode.md)",
        )


def drop_unsimulated_frames(e: Episode) -> Episode:
    """Return the episode without observations that a late clock would make after the last frame."""
    return e.without_observations_after(float(e.times[-1]) - MAX_CLOCK_DELAY_S)


def prefix_progress(progress: Progress, stage: str) -> Progress:
    """Return a callback that puts the stage in front of each line."""
    return lambda text: progress(f"{stage}: {text}")
