"""How much of what an oracle gains a diagnosis gains, on a motion that it never saw.

    (RMS of the base model - RMS of the extended one) / (RMS of the base model - RMS of the oracle)

All have their fabric's parameters fitted to the same episodes; the oracle is the library's own model with what was
hidden, at its true amplitude.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from torchcloth.diagnosis import Hypothesis, Model, World, approach, base_model, fit, load_model, setting_of
from torchcloth.diagnosis.causes.hypotheses import known
from torchcloth.diagnosis.data.binning import SEEN, cells_of
from torchcloth.diagnosis.data.dataset import Setting
from torchcloth.recordings import read
from torchcloth.recordings.consistency import together

LEAST = 2e-4  # m: where an oracle gains less, there is nothing to be gained


@dataclass(frozen=True)
class Oracle(Model):
    """A model that knows what is hidden."""

    hidden: tuple[tuple[Hypothesis, float], ...] = ()

    def world(self, extra: Sequence[tuple[Hypothesis, float]] = ()) -> World:
        """With what is hidden, first."""
        return super().world((*self.hidden, *extra))


def knowing(model: Model, truth: Mapping[str, Any]) -> Oracle | None:
    """The base model with all that is hidden; None where the library has no words or no sign for it."""
    words, hidden = {h.name: h for h in known()}, []
    for e in truth["effects"]:
        if e["hypothesis"] not in words or not e["sign"]:
            return None
        # wind brings the drag that makes it felt
        if not e["beside"]:
            hidden.append((words[e["hypothesis"]], e["amplitude"] * e["sign"]))
    return Oracle(model.base, model.parameters, model.values, hidden=tuple(hidden)) if hidden else None


def gain(
    episodes: Sequence[Path],
    fitted: Path,
    extended: Path,
    named: Collection[str],
    unseen: Path,
    truth: Mapping[str, Any],
) -> float | None:
    """The share of the oracle's gain; None where nothing is to be gained, or where nobody can know all.

    Args:
        episodes: those that were diagnosed.
        fitted: the base model that the diagnosis wrote, with the fabric's numbers fitted.
        extended: the same with its causes.
        named: its causes; what else it has, the answer does not say.
        unseen: an episode of another motion.
        truth: what was hidden.
    """
    recordings, last = [read(path) for path in episodes], read(unseen)
    base = base_model(together([*recordings, last]))
    oracle = knowing(base, truth)
    if oracle is None:
        return None
    before, best = rms(load_model(fitted), last), rms(_fitted(oracle, setting_of(base, recordings)), last)
    if before - best < LEAST:
        return None
    found = _saying(load_model(extended, residual=False), named)
    return (before - rms(found, last)) / (before - best) if found.accepted else 0.0


def _saying(model: Model, named: Collection[str]) -> Model:
    """Less the causes that have no name."""
    for h in model.accepted:
        model = model if h.name in named else model.without(h.name)
    return model


def _fitted(model: Model, setting: Setting) -> Model:
    near, before = approach(model, setting)
    return fit(near, setting, before=before).model


def rms(model: Model, recording: Any) -> float:
    """m, of the mean residuals of positions, on the finer mesh."""
    setting = setting_of(model, [recording]).finer
    if setting is None:
        raise ValueError("a setting without a finer one")
    episode, world = setting.episodes[0], replace(model, base=setting.base).world()
    cells = cells_of(world.frames(episode, setting.dt), None, episode, setting.sheet, setting.rest)
    return float(cells.value[cells.block < SEEN].square().mean().sqrt())
