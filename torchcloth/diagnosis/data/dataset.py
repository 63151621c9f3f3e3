"""Episodes as tensors, and the surface that their points are compared with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from ..._utils.caching import LRUCache, bytes_of
from ...episodes.observed import Episode, build_episode
from ...episodes.observed_surface import Sheet, sheet_for
from ...episodes.replay import Frames
from ...episodes.world import Model, World
from ...errors import InvalidInput
from ...identification.uncertainty.replicates import keys_of
from ...recordings import Recording
from .binning import BIN_SECONDS, MAX_BINS, EpisodeEvidence
from .fine_mesh import refine_model

MAX_POINTS_PER_FRAME = 8000  # points of a frame
FRAME_CACHE_BYTES = 256 * 2**20  # bytes of frames, at points that a search comes back to
MAX_CLOCK_DELAY_S = 0.05  # s, by which a clock may be late and its last frames still be simulated
MEANWHILE = f"after its first frame and before its last {MAX_CLOCK_DELAY_S:g} s"
Progress = Callable[[str], None]
EpisodeCache = Callable[[Sequence[object], Tensor, Callable[[], EpisodeEvidence]], EpisodeEvidence]  # (question, point, work) -> answer


def no_cache(question: Sequence[object], point: Tensor, work: Callable[[], EpisodeEvidence]) -> EpisodeEvidence:
    """Keeps nothing."""
    return work()


def label_motions(recordings: Sequence[Recording]) -> list[str]:
    """What each episode says its motion is, or that of the one it repeats; one that does not say is one of its own."""
    originals = {r.split.get("replicate_of") for r in recordings} - {None}
    given, out = {r.split.get("motion") for r in recordings}, []
    for k, (r, key) in enumerate(zip(recordings, keys_of(recordings), strict=True)):
        original = r.path is not None and r.path.name in originals
        says = original or r.split.get("motion") or r.split.get("replicate_of")
        own = f"episode {k}"
        while own in given:
            own += "'"
        out.append(str(key) if says else own)
    return out


def _recent() -> LRUCache[Frames]:
    return LRUCache(FRAME_CACHE_BYTES, lambda f: bytes_of(f.x, f.v, *f.wrench.values(), f.edge))


@dataclass(frozen=True, eq=False)
class DiagnosisData:
    """Episodes as tensors, and the surface that their points are compared with."""

    base: World
    recordings: tuple[Recording, ...]
    episodes: tuple[Episode, ...]
    sheet: Sheet
    rest_positions: Tensor  # [V, 3] m, the pattern
    dt: float | None = None
    fine_mesh: DiagnosisData | None = None
    bifurcating_bins: tuple[Tensor, ...] = ()  # per episode, keys of cells that jump; empty: not looked for
    cache: EpisodeCache = no_cache  # where finished episodes are kept
    recent_frames: LRUCache[Frames] = field(default_factory=_recent)  # what was simulated last

    @property
    def motions(self) -> list[str]:
        """Of the motions."""
        return label_motions(self.recordings)

    def without_bins(self, jumping: Sequence[Tensor]) -> DiagnosisData:
        """Without these cells as well, by their keys, one tensor per episode."""
        known = self.bifurcating_bins or [keys[:0] for keys in jumping]
        return replace(self, unstable=tuple(map(torch.cat, zip(known, jumping, strict=True))))


def prepare_data(model: Model, recordings: Sequence[Recording]) -> DiagnosisData:
    """Checks the recordings against the model, and prepares the same on a mesh twice as fine."""
    return replace(_setting(model, recordings), finer=_setting(*refine_model(model, recordings)))


def _setting(model: Model, recordings: Sequence[Recording]) -> DiagnosisData:
    cloth = model.base.cloth
    episodes = tuple(_telling(extend_for_clock(_thinned(build_episode(cloth, r)))) for r in recordings)
    mesh = cloth.mesh
    pattern = torch.as_tensor(mesh.vertices).double()
    if mesh.uv is not None:
        pattern = torch.nn.functional.pad(torch.as_tensor(mesh.uv).double(), (0, 1))
    else:  # its first two axes pass for u and v, so the thinnest comes last
        thin = int((pattern.amax(0) - pattern.amin(0)).argmin())
        pattern = pattern[:, [*(k for k in range(3) if k != thin), thin]]
    return DiagnosisData(model.base, tuple(recordings), episodes, sheet_for(cloth, episodes), pattern)


def _thinned(e: Episode) -> Episode:
    """With MOST points of a frame at most, drawn alike every time: more only take memory, means over parts are sure."""
    draw = torch.Generator().manual_seed(0)
    kept = lambda c: torch.randperm(len(c), generator=draw)[:MAX_POINTS_PER_FRAME].sort().values  # noqa: E731
    return replace(e, clouds=[c[kept(c)] if len(c) > MAX_POINTS_PER_FRAME else c for c in e.clouds])


def extend_for_clock(e: Episode) -> Episode:
    """With frames after the last as far as a late clock sees; without what it would see of none that is simulated.

    A cloth that stands still in its last frames instead is millimetres off, for no cause.
    """
    return drop_unsimulated_frames(e.with_lookahead(MAX_CLOCK_DELAY_S))


def _telling(e: Episode) -> Episode:
    """Raises InvalidInput for one that says nothing, its first frame being where the simulation starts; or too much."""
    lasts, longest = float(e.times[-1] - e.times[0]), MAX_BINS * BIN_SECONDS
    if lasts >= longest:
        got, expected = f"{e.name} of {lasts:.0f} s", f"less than {longest:.0f} s"
        raise InvalidInput("episode", got=got, expected=expected, remedy="cut it into several")
    if not _seen(e) and not any(bool(w[1:].isfinite().any()) for w in e.wrenches.values()):
        raise InvalidInput(
            "episode",
            got=f"{e.name}, in which nothing is seen or felt {MEANWHILE}",
            expected="frames with points, markers or forces",
            remedy="leave it out, or record longer",
        )
    return e


def _seen(e: Episode) -> bool:
    return any(len(c) for c in e.clouds[1:]) or (e.markers is not None and bool(e.markers[1:].isfinite().any()))


def check_positions_observed(setting: DiagnosisData) -> None:
    """Raises InvalidInput where nothing says where the cloth goes: forces alone do not."""
    if not any(map(_seen, setting.episodes)):
        raise InvalidInput(
            "episodes",
            got=f"none with points or markers {MEANWHILE}",
            expected="at least one that says where the cloth goes",
            remedy="record a depth camera or markers (docs/reference/episode.md)",
        )


def drop_unsimulated_frames(e: Episode) -> Episode:
    """Without what a late clock would see after the last frame."""
    return e.without_observations_after(float(e.times[-1]) - MAX_CLOCK_DELAY_S)


def prefix_progress(progress: Progress, stage: str) -> Progress:
    """The same, with what all lines are about in front."""
    return lambda text: progress(f"{stage}: {text}")
