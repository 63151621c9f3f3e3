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

from torchcloth.diagnosis import (
    Hypothesis,
    World,
    WorldModel,
    build_base_model,
    fit,
    load_model,
    prepare_data,
    quadratic_warm_start,
)
from torchcloth.diagnosis.causes.hypotheses import list_known_hypotheses
from torchcloth.diagnosis.data.binning import FORCE_BLOCK, bin_residuals
from torchcloth.diagnosis.data.dataset import DiagnosisData
from torchcloth.recordings import read
from torchcloth.recordings.consistency import merge_scene

LEAST = 2e-4  # m: where an oracle gains less, there is nothing to be gained


@dataclass(frozen=True)
class Oracle(WorldModel):
    """A model that knows what is hidden."""

    hidden: tuple[tuple[Hypothesis, float], ...] = ()

    def world(self, extra: Sequence[tuple[Hypothesis, float]] = ()) -> World:
        """With what is hidden, first."""
        return super().build_world((*self.hidden, *extra))


def knowing(model: WorldModel, truth: Mapping[str, Any]) -> Oracle | None:
    """The base model with all that is hidden; None where the library has no words or no sign for it."""
    words, hidden = {h.name: h for h in list_known_hypotheses()}, []
    for e in truth["effects"]:
        if e["hypothesis"] not in words or not e["sign"]:
            return None
        # wind brings the drag that makes it felt
        if not e["is_enabling"]:
            hidden.append((words[e["hypothesis"]], e["amplitude"] * e["sign"]))
    return Oracle(model.base, model.parameters, model.coordinates, hidden=tuple(hidden)) if hidden else None


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
    base = build_base_model(merge_scene([*recordings, last]))
    oracle = knowing(base, truth)
    if oracle is None:
        return None
    before, best = rms(load_model(fitted), last), rms(_fitted(oracle, prepare_data(base, recordings)), last)
    if before - best < LEAST:
        return None
    found = _saying(load_model(extended, residual=False), named)
    return (before - rms(found, last)) / (before - best) if found.accepted else 0.0


def _saying(model: WorldModel, named: Collection[str]) -> WorldModel:
    """Less the causes that have no name."""
    for h in model.accepted:
        model = model if h.name in named else model.without_hypothesis(h.name)
    return model


def _fitted(model: WorldModel, setting: DiagnosisData) -> WorldModel:
    near, before = quadratic_warm_start(model, setting)
    return fit(near, setting, before=before).model


def rms(model: WorldModel, recording: Any) -> float:
    """m, of the mean residuals of positions, on the finer mesh."""
    setting = prepare_data(model, [recording]).fine_mesh
    if setting is None:
        raise ValueError("a setting without a finer one")
    episode, world = setting.episodes[0], replace(model, base=setting.base).build_world()
    cells = bin_residuals(world.simulate_observed(episode, setting.dt), None, episode, setting.sheet, setting.rest_positions)
    return float(cells.value[cells.block < FORCE_BLOCK].square().mean().sqrt())
