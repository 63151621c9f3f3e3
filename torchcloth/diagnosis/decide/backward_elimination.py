"""What a search has accepted is doubted: causes that others make needless, or that stand for something unknown."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

from ...episodes.world import Hypothesis
from ...episodes.world_cache import IMPOSSIBLE
from ..data.dataset import Progress, DiagnosisData, prefix_progress
from ..inference.comparison import compare, select_episodes, predict_held_out
from ..inference.fitting import ModelFit, fit, reweight_by_noise, put_on_common_noise, remove_cause
from ..inference.lack_of_fit import compare_misfit, has_lack_of_fit, measure_lack_of_fit
from ..inference.linearise import restrict_to_common_bins
from ..inference.noise import compute_noise_floor
from ..inference.permutation_test import run_permutation_test
from .candidates import CLEAR, FURTHER, AcceptedCause, sole_informative_motions, known, worth_naming, worthwhile


def drop_redundant(
    current: ModelFit, steps: list[AcceptedCause], setting: DiagnosisData, hypotheses: Sequence[Hypothesis], progress: Progress
) -> tuple[ModelFit, list[AcceptedCause]]:
    """Less the causes that the others have made needless."""
    for step in steps:
        name = step.candidate.hypothesis.name
        sure = known(current, name, setting.motions, step.candidate)
        less, now = remove_cause(current, name), prefix_progress(progress, f"without {name}")
        try:
            less = fit(less, setting, (), 0, now, current.noise, current.linearisation)
        except IMPOSSIBLE:  # what it does keeps the others from what no cloth does
            continue
        without, there = (predict_held_out(f, setting.motions, step.candidate.sole_informative_motion) for f in put_on_common_noise(less, current))
        gain = compare(without, there, 0.0)
        if sure and worth_naming(step.candidate, gain):
            continue
        steps = [s for s in steps if s is not step]
        left = less.model.others(hypotheses)
        current = fit(less.model, setting, left, 1, progress, before=current.linearisation, here=less.linearisation)
    return current, steps


def replace_by_implied(
    current: ModelFit, steps: list[AcceptedCause], setting: DiagnosisData, hypotheses: Sequence[Hypothesis], progress: Progress
) -> tuple[ModelFit, list[AcceptedCause]]:
    """With what a cause brings along instead of it, where nothing of its own that matters is left.

    Drag that comes with wind, where the wind stood for a camera that is off until that was found.
    """
    for k, step in enumerate(steps):
        h, model = step.candidate.hypothesis, current.model
        other = step.replaced_by(h.implies)
        if (
            other is None
            or h.is_relevant(model.amplitudes[model.place(h.name)])
            or h.implies in (o.name for o in model.accepted)
        ):
            continue
        brought, alone = other.candidate.hypothesis, other.candidate.sole_informative_motion
        plain = remove_cause(current, h.name).plus(brought, brought.typical)  # what is there when h has gone
        left, now = plain.others(hypotheses), prefix_progress(progress, f"{h.implies} instead of {h.name}")
        try:
            found = fit(plain, setting, left, FURTHER, now, before=current.linearisation)
        except IMPOSSIBLE:
            continue
        chance = run_permutation_test(reweight_by_noise(other.candidate.fit, found.noise, found.linearisation), setting.motions, alone)
        if chance.is_passed and predictive_gain(current, found, setting.motions) < CLEAR:
            current, steps = found, [*steps[:k], replace(other, placebo=chance), *steps[k + 1 :]]
    return current, steps


def fraction_explained(start: ModelFit, end: ModelFit, names: Sequence[str], alone: Collection[str] = ()) -> float:
    """Share of what is wrong that is gone; 1 where nothing is lacking any more, or was before and less is wrong now.

    Of less than half, more is still there: whatever makes it may well do what passed for the causes, too. Where both
    meshes agree about less than half of the motions, the share held out, of all. Of cells that both fits have: points
    that vacuum finds on another part of the cloth would come back as if the causes had brought what is wrong with them.
    """
    alike = (replace(f, evidence=restrict_to_common_bins(f.linearisation, [other.linearisation])) for f, other in ((start, end), (end, start)))
    first, left = (measure_lack_of_fit(found, names) for found in alike)
    folded = {row.episode for row in (*first, *left) if not row.meshes_agree}
    if 2 * len(folded) <= len(names):
        if not has_lack_of_fit(end, names):
            return 1.0
        share = compare_misfit(first, left)
        return share if share < 0 or any(row.is_significant for row in first) else 1.0
    before, after = (predict_held_out(f, names, alone) for f in put_on_common_noise(start, end))
    return compare(before, after, compute_noise_floor(end.linearisation, end.noise)).explained_fraction


def supported_only_by_misfit_motions(start: ModelFit, end: ModelFit, steps: Sequence[AcceptedCause], names: Sequence[str]) -> bool:
    """Of the causes, motions that fit in the end say nothing, where some do."""
    left = measure_lack_of_fit(end, names)  # a motion whose cells all jump is not among them
    sound = {row.motion for row in left} - {row.motion for row in left if row.is_significant or not row.meshes_agree}
    told = [k for k, name in enumerate(names) if name in sound]
    alone = sole_informative_motions(steps)
    if not told:
        return False
    first, last = (predict_held_out(f, names, alone) for f in put_on_common_noise(start, end))
    return not worthwhile(compare(select_episodes(first, told), select_episodes(last, told), 0.0))


def predictive_gain(one: ModelFit, other: ModelFit, names: Sequence[str]) -> float:
    """Log density by which one fit of a model predicts motions held out better than another."""
    second, first = (predict_held_out(f, names) for f in put_on_common_noise(one, other))
    return compare(first, second, 0.0).log_density
