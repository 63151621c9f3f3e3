"""Verdict of a search, and the content of diagnosis.json."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from scipy.special import chdtrc, stdtrit
from torch import Tensor

from ..._utils.constants import Z_95
from ...episodes.world import Hypothesis, WorldModel
from ...errors import InvalidInput
from ...identification.result import nan_to_none
from ...recordings import Recording
from ..causes.glossary import describe
from ..data.data_checks import Fault
from ..inference.comparison import (
    Gain,
    compare_by_motion,
    count_effective_motions,
    jackknife,
    list_observed_motions,
)
from ..inference.confounding import are_fits_confounded
from ..inference.force_drift import estimate_force_drifts
from ..inference.lack_of_fit import measure_lack_of_fit
from ..report.cloud_overlays import CloudOverlay
from ..report.wording import collect_warnings, write_sentences
from ..unknown.localisation import localise_cause
from ..unknown.missing_force import MissingForce
from ..unknown.residual_force import ResidualForceFit
from .candidates import AcceptedCause
from .criteria import CRITERIA
from .gates import look_up_t_quantile
from .in_sample import rank_in_sample
from .search import SearchResult

SCHEMA = "torchcloth.diagnosis/1"
COORDINATE_NUDGE = 1e-4  # of a parameter's coordinate, for the slope of its value

Verdict = Literal["identified", "ambiguous", "unexplained", "adequate", "inconclusive", "numerics", "invalid_data"]


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """Result of ``diagnose``.

    Attributes:
        verdict: "identified" (each cause stands alone), "ambiguous" (some causes are confounded with others),
            "unexplained" (a lack of fit that no known cause explains), "adequate" (no known cause is surely relevant),
            "inconclusive" (these data cannot say, or a known cause would explain a single motion), "numerics" (another
            mesh changes more than a cause would), "invalid_data" (an episode cannot be used; nothing was simulated).
        content: the content of diagnosis.json.
        optional_search: the search; None of invalid data.
        missing_force: the force that is missing; None without a lack of fit.
        residual_force: local force laws that were learned; None if there is a cause and no lack of fit.
        overlays: one moment of each episode, for figures; empty if nobody simulated them.
        experiment: the proposed experiment as an episode without measurements.
    """

    verdict: Verdict
    content: dict[str, Any]
    optional_search: SearchResult | None
    missing_force: MissingForce | None = None
    residual_force: ResidualForceFit | None = None
    overlays: Sequence[CloudOverlay] = ()
    experiment: Recording | None = None

    @property
    def search(self) -> SearchResult:
        """The search.

        Raises:
            InvalidInput: the data were invalid.
        """
        if self.optional_search is None:
            raise InvalidInput("search", got="a diagnosis of invalid data", expected="episodes that can be used")
        return self.optional_search

    @property
    def model(self) -> WorldModel:
        """The base model with its fitted parameters and the accepted causes; raises as ``search``."""
        return self.search.end.model

    def summary(self) -> str:
        """Return the result in plain language, one sentence a line."""
        return "\n".join(write_sentences(self.verdict, self.content))


def judge(
    result: SearchResult,
    motions: Sequence[str],
    missing_force: MissingForce | None = None,
    residual_force: ResidualForceFit | None = None,
) -> Diagnosis:
    """Derive the verdict of a search and the content of diagnosis.json.

    Args:
        result: the search.
        motions: label of each episode.
        missing_force: the force that is missing, if it was estimated.
        residual_force: local force laws, if they were learned.
    """
    causes = [_describe_cause(result, cause, motions) for cause in result.causes]
    minor = [_describe_minor(result, cause) for cause in result.minor]
    mentioned = {name for m in minor for name in (m["effect"], *(r["effect"] for r in m["rivals"]))}
    mentioned |= {name for c in causes for name in (*c["equivalence_class"], *(r["effect"] for r in c["rivals"]))}
    explanations = [explanation.as_dict() for explanation in rank_in_sample(result)]
    mentioned |= {row["effect"] for row in explanations}
    scores = [score for score in result.scores if score.hypothesis.name not in mentioned]

    # the model lacks something if the residuals say so, if laws without a cause predict better, or if motions disagree
    rows, drifts = measure_lack_of_fit(result.end, motions), estimate_force_drifts(result.end, motions)
    has_laws = residual_force is not None and bool(residual_force.search.causes)
    is_inadequate = has_laws or bool(result.withdrawn) or any(row.is_significant for row in (*rows, *drifts))
    is_inadequate = is_inadequate or any(c["motions_disagree"] for c in causes)

    relevant_rivals = [r["effect"] for m in minor for r in m["rivals"]]
    is_doubtful = bool(relevant_rivals or result.end.model.strained_parameters or explanations)
    meshes_agree = all(row.meshes_agree for row in rows)
    # a motion that could be explained is not unexplained, though nothing confirms the explanation
    verdict = _decide(result, causes, is_inadequate and not explanations, meshes_agree or is_inadequate, is_doubtful)
    content = {
        "schema": SCHEMA,
        "verdict": verdict,
        "causes": causes,
        "initial_causes": _describe_initial_causes(result, motions),
        "minor": minor,
        "in_sample": explanations,
        "single_motion": not result.has_held_out_motions,
        "ruled_out": [s.hypothesis.name for s in scores if s.decision == "absent"],
        "wrong_sign": [s.hypothesis.name for s in scores if s.has_wrong_sign],
        "undecided": [
            *relevant_rivals,
            *(s.hypothesis.name for s in scores if s.decision in ("inconclusive", "present")),
        ],
        "unresolvable": [
            {
                "effect": s.hypothesis.name,
                "smallest_detectable": s.smallest_detectable if s.smallest_detectable < math.inf else None,
                "unit": s.hypothesis.unit,
            }
            for s in scores
            if s.decision == "unresolvable"
        ],
        "gain": _describe_gain(result, motions) if causes else None,
        "also_unexplained": bool(causes) and is_inadequate,
        "noise_floor": _describe_noise_floor(result),
        "lack_of_fit": [row.as_dict() for row in rows],
        "force_drifts": [drift.as_dict() for drift in drifts],
        "missing_force": None if missing_force is None else missing_force.as_dict(),
        "residual_force": None if residual_force is None else residual_force.as_dict(),
        "next_experiment": None,
        "parameters": _describe_parameters(result, motions),
        "common_relative_error": CRITERIA.report.common_relative_error,
        "warnings": collect_warnings(result, motions, rows),
        "motions": list(motions),
    }
    return Diagnosis(verdict, content, result, missing_force, residual_force)


def refuse(faults: Sequence[Fault], motions: Sequence[str] = ()) -> Diagnosis:
    """Return the result for episodes that cannot be used: their faults.

    Args:
        faults: what makes the episodes unusable.
        motions: label of each episode.
    """
    lists = (
        "causes", "initial_causes", "minor", "in_sample", "ruled_out", "wrong_sign", "undecided", "unresolvable",
        "lack_of_fit", "force_drifts", "warnings",
    )  # fmt: skip
    optional = ("gain", "missing_force", "residual_force", "next_experiment", "model", "plan_hash")
    content = {
        "schema": SCHEMA,
        **{key: [] for key in lists},
        **dict.fromkeys(optional),
        "verdict": "invalid_data",
        "also_unexplained": False,
        "single_motion": False,
        "parameters": {},
        "faults": [{"episode": f.episode, "what": f.what, "remedy": f.remedy} for f in faults],
        "motions": list(motions),
    }
    return Diagnosis("invalid_data", content, None)


def _decide(
    result: SearchResult,
    causes: Sequence[dict[str, Any]],
    is_inadequate: bool,
    meshes_agree: bool,
    is_doubtful: bool,
) -> Verdict:
    if causes:
        stand_alone = all(not c["rivals"] and len(c["equivalence_class"]) == 1 for c in causes)
        return "identified" if stand_alone else "ambiguous"
    if is_inadequate:
        return "unexplained"
    if not meshes_agree:
        return "numerics"
    is_undecided = any(score.decision == "present" for score in result.scores)
    return "inconclusive" if is_undecided or is_doubtful else "adequate"


def _describe_minor(result: SearchResult, cause: AcceptedCause) -> dict[str, Any]:
    """Return what is too small to be relevant, and what is confounded with it and would be relevant."""
    pairs = result.equivalents(cause)
    small = next((h, a) for h, a in pairs if not h.is_relevant(a))
    return {**_describe_amplitude(*small), "rivals": [_describe_amplitude(h, a) for h, a in pairs if h.is_relevant(a)]}


def _describe_amplitude(hypothesis: Hypothesis, amplitude: float) -> dict[str, Any]:
    return {"effect": hypothesis.name, "amplitude": amplitude, "unit": hypothesis.unit}


def _describe_initial_causes(result: SearchResult, motions: Sequence[str]) -> list[dict[str, Any]]:
    """Return the causes of the model that the search started with, fitted again."""
    model, n_parameters = result.end.model, len(result.end.model.parameters)
    initial = result.start.model.accepted
    std = _coordinate_errors(result, motions).tolist() if initial else []
    rows = []
    for h in initial:
        index = model.index_of(h.name)
        amplitude = model.amplitudes[index]
        half_width = Z_95 * _add_common_error(std[n_parameters + index], amplitude)
        rows.append({**_describe_amplitude(h, amplitude), "ci95": [amplitude - half_width, amplitude + half_width]})
    return rows


def _describe_cause(result: SearchResult, cause: AcceptedCause, motions: Sequence[str]) -> dict[str, Any]:
    candidate, h, n_parameters = cause.candidate, cause.candidate.hypothesis, len(result.end.model.parameters)
    index, amplitude = result.end.model.index_of(h.name), result.amplitude(cause)
    coordinate = n_parameters + index
    noise_std, std, effective = _amplitude_errors(result, coordinate, motions, candidate.sole_informative_motion)
    noise_std, std = (math.hypot(error, candidate.score.mesh_bias) for error in (noise_std, std))
    std = _add_common_error(std, amplitude)
    rivals = result.rivals(cause)
    confounded = [score.hypothesis.name for score in result.confounded_scores(cause)]
    confounded += [c.hypothesis.name for c in rivals if are_fits_confounded(candidate.fit, c.fit, cause.noise)]
    test = cause.permutation_test
    return {
        **_describe_amplitude(h, amplitude),
        "ci95": [amplitude - Z_95 * std, amplitude + Z_95 * std],
        "noise_ci95": [amplitude - Z_95 * noise_std, amplitude + Z_95 * noise_std],
        "effective_motions": effective,
        "motions_disagree": _do_motions_disagree(result, coordinate, effective, motions),
        "typical": h.typical,
        "description": describe(h),
        "equivalence_class": sorted({h.name, *confounded, *h.structurally_equivalent}),
        "rivals": [_describe_amplitude(c.hypothesis, c.amplitude) for c in rivals],
        "rms_removed_mm": 1e3 * (candidate.gain.rms_before - candidate.gain.rms_after),
        "permutation_test": {"log_density": test.gain, "quantile_95": test.quantile_95 or None},
        "explained_fraction": _fraction_of_cause(result, candidate.gain),
        **localise_cause(result.end, h.name, motions, result.data.episodes, _list_gaining_motions(result, motions)),
    }


def _list_gaining_motions(result: SearchResult, motions: Sequence[str]) -> list[str]:
    """Return the motions that the causes predict better, held out."""
    if result.total_gain is None:
        return []
    gains = compare_by_motion(*result.held_out, result.noise_floor, motions)
    return [motion for motion, gain in gains.items() if gain.log_density > 0]


def _coordinate_errors(result: SearchResult, motions: Sequence[str]) -> Tensor:
    """Return [P + A] standard errors of the coordinates: the larger of those by noise and by disagreement of motions.

    Few motions say little about how much they disagree, so the latter are widened: ``Z_95`` of them is as wide as
    Student's interval.
    """
    noise_std = result.end.covariance.diagonal().sqrt()
    factor = look_up_t_quantile(list_observed_motions(result.end.whitened.episode, motions)) / Z_95
    if not factor < math.inf:
        return noise_std
    return torch.maximum(noise_std, factor * jackknife(result.end, motions)[1])


def _amplitude_errors(
    result: SearchResult, coordinate: int, motions: Sequence[str], sole: Collection[str]
) -> tuple[float, float, float]:
    """Return (standard error by noise, the larger of it and that of motions, effective number of motions).

    If hardly more than one motion informs, little is known about how much motions disagree.
    """
    noise_std = float(result.end.covariance[coordinate, coordinate]) ** 0.5
    effective, effective_folds = (
        count_effective_motions(result.end, coordinate, motions, halved) for halved in ((), sole)
    )
    if effective_folds <= 1.0:
        return noise_std, noise_std, effective
    factor = float(stdtrit(max(effective_folds - 1.0, 1.0), 0.975)) / Z_95
    motion_std = float(jackknife(result.end, motions, sole)[1][coordinate])
    return noise_std, max(noise_std, factor * motion_std), effective


def _do_motions_disagree(result: SearchResult, coordinate: int, effective: float, motions: Sequence[str]) -> bool:
    """Whether motions differ about an amplitude by more than noise: then the cause is not quite what happens.

    Cochran's Q is the effective number of motions less one, times the ratio of the two variances. It is compared with a
    chi-squared distribution with as many degrees of freedom.
    """
    criteria = CRITERIA.heterogeneity
    if effective < criteria.min_effective_motions:
        return False
    motion_variance = jackknife(result.end, motions)[1].square()[coordinate]
    ratio = float(motion_variance / result.end.covariance[coordinate, coordinate])
    return bool(chdtrc(effective - 1.0, (effective - 1.0) * ratio) < criteria.max_p_value)


def _add_common_error(std: float, value: float) -> float:
    return math.hypot(std, CRITERIA.report.common_relative_error * value)


def _fraction_of_cause(result: SearchResult, gain: Gain) -> float | None:
    """Return the part of the explained fraction of all causes that is due to one, by its gain in log density."""
    total = sum(max(0.0, cause.candidate.gain.log_density) for cause in result.accepted)
    if result.total_gain is None or not total:
        return None
    return max(0.0, result.total_gain.explained_fraction) * max(0.0, gain.log_density) / total


def _describe_gain(result: SearchResult, motions: Sequence[str]) -> dict[str, Any] | None:
    if result.total_gain is None:
        return None
    total, by_motion = result.total_gain, compare_by_motion(*result.held_out, result.noise_floor, motions)
    rows = []
    for motion, g in by_motion.items():
        has_positions, has_interval = not math.isnan(g.rms_before), g.lower_bound_95 > -math.inf
        rows.append(
            {
                "motion": motion,
                "rms_before": nan_to_none(g.rms_before),
                "rms_after": nan_to_none(g.rms_after),
                "explained_fraction": g.explained_fraction if has_positions else None,
                "explained_fraction_ci95": list(g.explained_fraction_ci95) if has_positions and has_interval else None,
                "log_density": g.log_density,
                "log_density_ci95": list(g.log_density_ci95) if has_interval else None,
            }
        )
    return {
        "rms_before": total.rms_before,
        "rms_after": total.rms_after,
        "noise_floor": result.noise_floor,
        "unit": "m",
        "explained_fraction": total.explained_fraction,
        "explained_fraction_ci95": list(total.explained_fraction_ci95),
        "log_density": total.log_density,
        "log_density_ci95": list(total.log_density_ci95),
        "per_motion": rows,
    }


def _describe_noise_floor(result: SearchResult) -> dict[str, Any]:
    """Return what a correct model would leave of a bin, and the source of that number."""
    floor = result.replicate_floor
    return {
        "value": result.noise_floor,
        "sensor": result.sensor_floor,
        "unit": "m",
        "bifurcating_fraction": result.bifurcating_fraction,
        "source": "sensor only" if floor is None else "repetitions",
        "pairs": 0 if floor is None else floor.pairs,
    }


def _describe_parameters(result: SearchResult, motions: Sequence[str]) -> dict[str, Any]:
    model, out = result.end.model, {}
    errors = _coordinate_errors(result, motions).tolist()
    for p, c, std in zip(model.parameters, model.coordinates.tolist(), errors, strict=False):
        value = p.value(c)
        slope = (p.value(c + COORDINATE_NUDGE) - p.value(c - COORDINATE_NUDGE)) / (2 * COORDINATE_NUDGE)
        half_width = Z_95 * _add_common_error(std, value / slope)
        ends = (p.value(min(max(end, p.min_coordinate), p.max_coordinate)) for end in (c - half_width, c + half_width))
        out[p.name] = {"value": value, "ci95": sorted(ends), "unit": p.unit, "data_sheet": p.value(0.0)}
    return out
