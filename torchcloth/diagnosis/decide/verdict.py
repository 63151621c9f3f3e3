"""From a search to an answer in words and numbers."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from scipy.special import chdtrc, stdtrit
from torch import Tensor

from ...episodes.world import Hypothesis, Model
from ...errors import InvalidInput
from ...identification.result import or_none
from ...recordings import Recording
from ..causes.glossary import meaning
from ..data.data_checks import Fault
from ..inference.comparison import Gain, compare_by_motion, list_observed_motions, jackknife, count_effective_motions
from ..inference.confounding import are_fits_confounded
from ..inference.force_drift import estimate_force_drifts
from ..inference.lack_of_fit import measure_lack_of_fit
from ..report.cloud_overlays import CloudOverlay
from ..report.wording import write_sentences, collect_warnings
from ..unknown.localisation import localise_cause
from ..unknown.missing_force import MissingForce
from ..unknown.residual_force import ResidualForceFit
from .candidates import NORMAL, AcceptedCause, between_motions
from .search import SearchResult

COMMON = 0.03  # of a number, standard deviation: what is wrong in all motions alike, by sealed answers
NUDGE = 1e-4  # of a coordinate, for its value's slope
DISAGREE, TWO = 0.005, 2.0  # chance below which motions disagree about a number; as many must tell of it

Verdict = Literal["identified", "ambiguous", "unexplained", "adequate", "inconclusive", "numerics", "invalid_data"]


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What the simulation gets wrong.

    Attributes:
        verdict: "identified" (each cause stands alone), "ambiguous" (some cannot be told from others), "unexplained"
            (the fit is lacking and nothing known mends it), "adequate" (no known cause is surely larger than what
            matters), "inconclusive" (these data cannot say), "numerics" (another mesh changes more than a cause
            would), "invalid_data" (an episode cannot be believed, and nothing was simulated).
        content: all of it, as diagnosis.json has it.
        searched: the search; None of invalid data.
        missing: the force that is missing, where the fit is lacking.
        residual: laws of a force that were learned, where the fit is lacking or no cause is named.
        overlays: a moment of each episode, for pictures; none, where nobody simulated them.
        experiment: the one that is proposed as an episode, with blanks for what will be seen and felt.
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
        """The search, for pictures and for those who want to know.

        Raises:
            InvalidInput: the data were invalid.
        """
        if self.optional_search is None:
            raise InvalidInput("found", got="a diagnosis of invalid data", expected="episodes that can be believed")
        return self.optional_search

    @property
    def model(self) -> Model:
        """The base model with its fitted parameters and the accepted causes; raises as ``found``."""
        return self.search.end.model

    def summary(self) -> str:
        """Plain language."""
        return "\n".join(write_sentences(self.verdict, self.content))


def judge(
    found: SearchResult, names: Sequence[str], missing: MissingForce | None = None, residual: ResidualForceFit | None = None
) -> Diagnosis:
    """The answer of a search over episodes with these motions, and of what was learned beyond it."""
    causes = [_cause(found, step, names) for step in found.causes]
    minor = [_minor(found, step) for step in found.minor]
    told = {name for m in minor for name in (m["effect"], *(r["effect"] for r in m["rivals"]))}
    told |= {name for c in causes for name in (*c["class"], *(r["effect"] for r in c["rivals"]))}
    rows = [r for r in found.scores if r.hypothesis.name not in told]
    left, drifting = measure_lack_of_fit(found.end, names), estimate_force_drifts(found.end, names)
    learned = residual is not None and bool(residual.search.causes)
    lacking = learned or bool(found.withdrawn) or any(row.is_significant for row in (*left, *drifting))
    lacking = lacking or any(c["motions_disagree"] for c in causes)
    doubtful = [r["effect"] for m in minor for r in m["rivals"]]
    stable = all(row.meshes_agree for row in left)
    verdict = _verdict(found, causes, lacking, stable, bool(doubtful or found.end.model.strained))
    content = {
        "verdict": verdict,
        "causes": causes,
        "given": _given(found, names),
        "minor": minor,
        "ruled_out": [r.hypothesis.name for r in rows if r.decision == "absent"],
        "wrong_sign": [r.hypothesis.name for r in rows if r.has_wrong_sign],
        "undecided": [*doubtful, *(r.hypothesis.name for r in rows if r.decision in ("inconclusive", "present"))],
        "unresolvable": [
            {"effect": r.hypothesis.name, "smallest_detectable": _finite(r.smallest_detectable), "unit": r.hypothesis.unit}
            for r in rows
            if r.decision == "unresolvable"
        ],
        "gain": _gain(found, names) if causes else None,
        "also_unexplained": bool(causes) and lacking,
        "floor": _floor(found),
        "lack_of_fit": [row.as_dict() for row in left],
        "drifts": [row.as_dict() for row in drifting],
        "missing_force": None if missing is None else missing.as_dict(),
        "residual": None if residual is None else residual.as_dict(),
        "next_experiment": None,
        "parameters": _parameters(found, names),
        "common_error": COMMON,
        "warnings": collect_warnings(found, names, left),
        "motions": list(names),
    }
    return Diagnosis(verdict, content, found, missing, residual)


def refuse(faults: Sequence[Fault], names: Sequence[str] = ()) -> Diagnosis:
    """The answer where episodes cannot be believed: what is wrong with them."""
    keys = "causes given minor ruled_out wrong_sign undecided unresolvable lack_of_fit drifts warnings"
    lists: dict[str, Any] = {key: [] for key in keys.split()}
    none = dict.fromkeys(("gain", "missing_force", "residual", "next_experiment", "model", "plan_hash"))
    said = [{"episode": f.episode, "what": f.what, "remedy": f.remedy} for f in faults]
    content = {**lists, **none, "verdict": "invalid_data", "also_unexplained": False, "parameters": {}}
    return Diagnosis("invalid_data", {**content, "faults": said, "motions": list(names)}, None)


def _verdict(found: SearchResult, causes: Sequence[dict[str, Any]], lacking: bool, stable: bool, doubtful: bool) -> Verdict:
    if causes:
        return "identified" if all(not c["rivals"] and len(c["class"]) == 1 for c in causes) else "ambiguous"
    if lacking:
        return "unexplained"
    if not stable:
        return "numerics"
    undecided = [r for r in found.scores if r.decision == "present"]
    return "inconclusive" if undecided or doubtful else "adequate"


def _minor(found: SearchResult, step: AcceptedCause) -> dict[str, Any]:
    """What is too small to matter, and what cannot be told from it and would matter."""
    alike = found.equivalents(step)
    small = next(pair for pair in alike if not pair[0].is_relevant(pair[1]))
    return {**_told(*small), "rivals": [_told(h, a) for h, a in alike if h.is_relevant(a)]}


def _told(hypothesis: Hypothesis, amplitude: float) -> dict[str, Any]:
    return {"effect": hypothesis.name, "amplitude": amplitude, "unit": hypothesis.unit}


def _given(found: SearchResult, names: Sequence[str]) -> list[dict[str, Any]]:
    """Causes that the model came with, fitted anew."""
    model, first = found.end.model, len(found.end.model.parameters)
    given = found.start.model.accepted
    std = _errors(found, names).tolist() if given else []
    out = []
    for h in given:
        place = model.place(h.name)
        amplitude = model.amplitudes[place]
        error = NORMAL * _with_common(std[first + place], amplitude)
        out.append({**_told(h, amplitude), "ci95": [amplitude - error, amplitude + error]})
    return out


def _cause(found: SearchResult, step: AcceptedCause, names: Sequence[str]) -> dict[str, Any]:
    best, h, count = step.candidate, step.candidate.hypothesis, len(found.end.model.parameters)
    place, amplitude = found.end.model.place(h.name), found.amplitude(step)
    noise, std, told = _error(found, count + place, names, best.sole_informative_motion)
    noise, std = (math.hypot(error, best.score.mesh_bias) for error in (noise, std))
    std = _with_common(std, amplitude)
    kin = [r.hypothesis.name for r in found.confounded_scores(step)]
    rivals = found.rivals(step)
    kin += [c.hypothesis.name for c in rivals if are_fits_confounded(best.fit, c.fit, step.noise)]
    return {
        **_told(h, amplitude),
        "ci95": [amplitude - NORMAL * std, amplitude + NORMAL * std],
        "noise_ci95": [amplitude - NORMAL * noise, amplitude + NORMAL * noise],
        "told_by": told,
        "motions_disagree": _disagreed(found, count + place, told, names),
        "typical": h.typical,
        "says": meaning(h),
        "class": sorted({h.name, *kin, *h.structurally_equivalent}),
        "rivals": [_told(c.hypothesis, c.amplitude) for c in rivals],
        "gain_mm": 1e3 * (best.gain.rms_before - best.gain.rms_after),
        "placebo": {"log_density": step.permutation_test.gain, "chance": step.permutation_test.quantile_95 or None},
        "share_of_explainable": _share(found, best.gain),
        **localise_cause(found.end, h.name, names, found.data.episodes),
    }


def _errors(found: SearchResult, names: Sequence[str]) -> Tensor:
    """[P + A] standard errors of the model's coordinates: the wider of what noise allows and motions disagree by.

    Few motions know little of what they disagree by: NORMAL of these errors is as wide as Student's interval.
    """
    own = found.end.covariance.diagonal().sqrt()
    wider = between_motions(list_observed_motions(found.end.whitened.episode, names)) / NORMAL
    return torch.maximum(own, wider * jackknife(found.end, names)[1]) if wider < math.inf else own


def _error(found: SearchResult, place: int, names: Sequence[str], alone: Collection[str]) -> tuple[float, float, float]:
    """Of one coordinate: (standard error by noise alone, as ``_errors``, how many motions tell of it).

    Where hardly more than one does, little is known of what motions disagree by.
    """
    own = float(found.end.covariance[place, place]) ** 0.5
    motions, count = (count_effective_motions(found.end, place, names, halved) for halved in ((), alone))
    if count <= 1.0:
        return own, own, motions
    wider = float(stdtrit(max(count - 1.0, 1.0), 0.975)) / NORMAL
    return own, max(own, wider * float(jackknife(found.end, names, alone)[1][place])), motions


def _disagreed(found: SearchResult, place: int, told: float, names: Sequence[str]) -> bool:
    """Motions differ about a number by more than noise makes them: what it stands for is not quite what happens.

    Cochran's Q: ``told`` - 1 times the ratio of the two variances, against chi^2 of as many degrees of freedom.
    """
    if told < TWO:
        return False
    ratio = float(jackknife(found.end, names)[1].square()[place] / found.end.covariance[place, place])
    return bool(chdtrc(told - 1.0, (told - 1.0) * ratio) < DISAGREE)


def _with_common(std: float, number: float) -> float:
    return math.hypot(std, COMMON * number)


def _share(found: SearchResult, gain: Gain) -> float | None:
    """Of what all causes explain together, by what each adds to the predictive density."""
    every = sum(max(0.0, step.candidate.gain.log_density) for step in found.accepted)
    if found.total_gain is None or not every:
        return None
    return max(0.0, found.total_gain.explained_fraction) * max(0.0, gain.log_density) / every


def _gain(found: SearchResult, names: Sequence[str]) -> dict[str, Any] | None:
    if found.total_gain is None:
        return None
    g, motions = found.total_gain, compare_by_motion(*found.held_out, found.noise_floor, names)
    return {
        "rms_before": g.rms_before,
        "rms_after": g.rms_after,
        "floor": found.noise_floor,
        "unit": "m",
        "explained_fraction": g.explained_fraction,
        "ci95": list(g.explained_fraction_ci95),
        "log_density": g.log_density,
        "log_density_ci95": list(g.log_density_ci95),
        "per_motion": [
            {
                "motion": name,
                "rms_before": or_none(m.rms_before),
                "rms_after": or_none(m.rms_after),
                "explained_fraction": None if math.isnan(m.rms_before) else m.explained_fraction,
                "ci95": None if math.isnan(m.rms_before) or m.lower_bound_95 == -math.inf else list(m.explained_fraction_ci95),
                "log_density": m.log_density,
                "log_density_ci95": None if m.lower_bound_95 == -math.inf else list(m.log_density_ci95),
            }
            for name, m in motions.items()
        ],
    }


def _floor(found: SearchResult) -> dict[str, Any]:
    """What a true model would leave of a cell, and where that is known from."""
    out: dict[str, Any] = {"value": found.noise_floor, "sensor": found.sensor_floor, "unit": "m", "left_out": found.bifurcating_fraction}
    if found.replicate_floor is None:
        return {**out, "source": "sensor only", "pairs": 0}
    return {**out, "source": "repetitions", "pairs": found.replicate_floor.pairs}


def _parameters(found: SearchResult, names: Sequence[str]) -> dict[str, Any]:
    model, out = found.end.model, {}
    for p, c, s in zip(model.parameters, model.values.tolist(), _errors(found, names).tolist(), strict=False):
        value, slope = p.value(c), (p.value(c + NUDGE) - p.value(c - NUDGE)) / (2 * NUDGE)
        wide = NORMAL * _with_common(s, value / slope)
        ends = (p.value(min(max(end, p.low), p.high)) for end in (c - wide, c + wide))
        out[p.name] = {"value": value, "ci95": sorted(ends), "unit": p.unit, "data_sheet": p.value(0.0)}
    return out


def _finite(value: float) -> float | None:
    return value if value < float("inf") else None
