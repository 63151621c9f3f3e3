"""Episodes as tensors, and the surface that their points are compared with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from ..._utils.caching import Recent, size_of
from ...episodes.observed import Episode, episode
from ...episodes.observed_surface import Sheet, sheet_for
from ...episodes.replay import Frames
from ...episodes.world import Model, World
from ...errors import InvalidInput
from ...identification.uncertainty.replicates import keys_of
from ...recordings import Recording
from .binning import STRETCH, WINDOWS, Piece
from .fine_mesh import refined

MOST = 8000  # points of a frame
REMEMBERED = 256 * 2**20  # bytes of frames, at points that a search comes back to
LATE = 0.05  # s, by which a clock may be late and its last frames still be simulated
MEANWHILE = f"after its first frame and before its last {LATE:g} s"
Progress = Callable[[str], None]
Kept = Callable[[Sequence[object], Tensor, Callable[[], Piece]], Piece]  # (question, point, work) -> answer


def simply(question: Sequence[object], point: Tensor, work: Callable[[], Piece]) -> Piece:
    """Keeps nothing."""
    return work()


def motions_of(recordings: Sequence[Recording]) -> list[str]:
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


def _recent() -> Recent[Frames]:
    return Recent(REMEMBERED, lambda f: size_of(f.x, f.v, *f.wrench.values(), f.edge))


@dataclass(frozen=True, eq=False)
class Setting:
    """Episodes as tensors, and the surface that their points are compared with."""

    base: World
    recordings: tuple[Recording, ...]
    episodes: tuple[Episode, ...]
    sheet: Sheet
    rest: Tensor  # [V, 3] m, the pattern
    dt: float | None = None
    finer: Setting | None = None
    unstable: tuple[Tensor, ...] = ()  # per episode, keys of cells that jump; empty: not looked for
    kept: Kept = simply  # where finished episodes are kept
    recent: Recent[Frames] = field(default_factory=_recent)  # what was simulated last

    @property
    def names(self) -> list[str]:
        """Of the motions."""
        return motions_of(self.recordings)

    def less(self, jumping: Sequence[Tensor]) -> Setting:
        """Without these cells as well, by their keys, one tensor per episode."""
        known = self.unstable or [keys[:0] for keys in jumping]
        return replace(self, unstable=tuple(map(torch.cat, zip(known, jumping, strict=True))))


def setting_of(model: Model, recordings: Sequence[Recording]) -> Setting:
    """Checks the recordings against the model, and prepares the same on a mesh twice as fine."""
    return replace(_setting(model, recordings), finer=_setting(*refined(model, recordings)))


def _setting(model: Model, recordings: Sequence[Recording]) -> Setting:
    cloth = model.base.cloth
    episodes = tuple(_telling(foreseen(_thinned(episode(cloth, r)))) for r in recordings)
    mesh = cloth.mesh
    pattern = torch.as_tensor(mesh.vertices).double()
    if mesh.uv is not None:
        pattern = torch.nn.functional.pad(torch.as_tensor(mesh.uv).double(), (0, 1))
    else:  # its first two axes pass for u and v, so the thinnest comes last
        thin = int((pattern.amax(0) - pattern.amin(0)).argmin())
        pattern = pattern[:, [*(k for k in range(3) if k != thin), thin]]
    return Setting(model.base, tuple(recordings), episodes, sheet_for(cloth, episodes), pattern)


def _thinned(e: Episode) -> Episode:
    """With MOST points of a frame at most, drawn alike every time: more only take memory, means over parts are sure."""
    draw = torch.Generator().manual_seed(0)
    kept = lambda c: torch.randperm(len(c), generator=draw)[:MOST].sort().values  # noqa: E731
    return replace(e, clouds=[c[kept(c)] if len(c) > MOST else c for c in e.clouds])


def foreseen(e: Episode) -> Episode:
    """With frames after the last as far as a late clock sees; without what it would see of none that is simulated.

    A cloth that stands still in its last frames instead is millimetres off, for no cause.
    """
    return surely_seen(e.beyond(LATE))


def _telling(e: Episode) -> Episode:
    """Raises InvalidInput for one that says nothing, its first frame being where the simulation starts; or too much."""
    lasts, longest = float(e.times[-1] - e.times[0]), WINDOWS * STRETCH
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


def somewhere_seen(setting: Setting) -> None:
    """Raises InvalidInput where nothing says where the cloth goes: forces alone do not."""
    if not any(map(_seen, setting.episodes)):
        raise InvalidInput(
            "episodes",
            got=f"none with points or markers {MEANWHILE}",
            expected="at least one that says where the cloth goes",
            remedy="record a depth camera or markers (docs/episode.md)",
        )


def surely_seen(e: Episode) -> Episode:
    """Without what a late clock would see after the last frame."""
    return e.unseen_after(float(e.times[-1]) - LATE)


def staged(progress: Progress, stage: str) -> Progress:
    """The same, with what all lines are about in front."""
    return lambda text: progress(f"{stage}: {text}")
