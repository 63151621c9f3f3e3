"""Gain of a diagnosis relative to that of an oracle, on a motion that it never saw.

    (RMS of the base model - RMS of the extended one) / (RMS of the base model - RMS of the oracle)

The fabric parameters of all three are fitted to the same episodes. The oracle is the library's own model with the
hidden effects at their true amplitudes.
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

MIN_ORACLE_GAIN_M = 2e-4  # below this gain of the oracle, the ratio is not defined


@dataclass(frozen=True)
class Oracle(WorldModel):
    """Model that knows the hidden effects.

    Attributes:
        hidden: hypotheses with their true amplitudes.
    """

    hidden: tuple[tuple[Hypothesis, float], ...] = ()

    def build_world(self, extra: Sequence[tuple[Hypothesis, float]] = ()) -> World:
        """Build the world with the hidden effects, then with further (hypothesis, amplitude) pairs."""
        return super().build_world((*self.hidden, *extra))


def build_oracle(model: WorldModel, truth: Mapping[str, Any]) -> Oracle | None:
    """Return the base model with all hidden effects; None if the library has no hypothesis or no sign for one."""
    words, hidden = {h.name: h for h in list_known_hypotheses()}, []
    for e in truth["effects"]:
        if e["hypothesis"] not in words or not e["sign"]:
            return None
        # The hypothesis of wind brings its drag.
        if not e["is_enabling"]:
            hidden.append((words[e["hypothesis"]], e["amplitude"] * e["sign"]))
    return Oracle(model.base, model.parameters, model.coordinates, hidden=tuple(hidden)) if hidden else None


def relative_gain(
    episodes: Sequence[Path],
    fitted: Path,
    extended: Path,
    named: Collection[str],
    unseen: Path,
    truth: Mapping[str, Any],
) -> float | None:
    """Return the gain relative to the oracle's; None if the oracle gains nothing or does not exist.

    Args:
        episodes: the diagnosed ones.
        fitted: the base model that the diagnosis wrote, with fitted fabric parameters.
        extended: the same with accepted causes.
        named: the causes that the answer names; others of the extended model are removed.
        unseen: an episode of another motion.
        truth: of the case.
    """
    recordings, last = [read(path) for path in episodes], read(unseen)
    base = build_base_model(merge_scene([*recordings, last]))
    oracle = build_oracle(base, truth)
    if oracle is None:
        return None
    before = position_rms(load_model(fitted), last)
    best = position_rms(_fit(oracle, prepare_data(base, recordings)), last)
    if before - best < MIN_ORACLE_GAIN_M:
        return None
    extended_model = _keep_named(load_model(extended, residual=False), named)
    return (before - position_rms(extended_model, last)) / (before - best) if extended_model.accepted else 0.0


def _keep_named(model: WorldModel, named: Collection[str]) -> WorldModel:
    """Return the model without the causes that the answer does not name."""
    for h in model.accepted:
        model = model if h.name in named else model.without_hypothesis(h.name)
    return model


def _fit(model: WorldModel, data: DiagnosisData) -> WorldModel:
    near, before = quadratic_warm_start(model, data)
    return fit(near, data, before=before).model


def position_rms(model: WorldModel, recording: Any) -> float:
    """Return the RMS [m] of the binned position residuals, on the finer mesh."""
    data = prepare_data(model, [recording]).fine_mesh
    if data is None:
        raise ValueError("data without a finer mesh")
    episode, world = data.episodes[0], replace(model, base=data.base).build_world()
    frames = world.simulate_observed(episode, data.dt)
    bins = bin_residuals(frames, None, episode, data.surface, data.rest_positions)
    return float(bins.value[bins.block < FORCE_BLOCK].square().mean().sqrt())
