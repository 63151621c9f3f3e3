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
from ..inference.comparison import Gain, by_motion, heard, spread, told_by
from ..inference.confounding import fitted_alike
from ..inference.force_drift import drifts
from ..inference.lack_of_fit import lack_of_fit
from ..report.cloud_overlays import Overlay
from ..report.wording import sentences, warnings_of
from ..unknown.localisation import shown
from ..unknown.missing_force import MissingForce
from ..unknown.residual_force import Residual
from .candidates import NORMAL, Step, between_motions
from .search import Found

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
    searched: Found | None
    missing: MissingForce | None = None
    residual: Residual | None = None
    overlays: Sequence[Overlay] = ()
    experiment: Recording | None = None

    @property
    def found(self) -> Found:
        """The search, for pictures and for those who want to know.

        Raises:
            InvalidInput: the data were invalid.
        """
        if self.searched is None:
            raise InvalidInput("found", got="a diagnosis of invalid data", expected="episodes that can be believed")
        return self.searched

    @property
    def model(self) -> Model:
        """The base model with its fitted parameters and the accepted causes; raises as ``found``."""
        return self.found.end.model

    def summary(self) -> str:
        """Plain language."""
        return "\n".join(sentences(self.verdict, self.content))


def judge(
    found: Found, names: Sequence[str], missing: MissingForce | None = None, residual: Residual | None = None
) -> Diagnosis:
    """The answer of a search over episodes with these motions, and of what was learned beyond it."""
    causes = [_cause(found, step, names) for step in found.causes]
    minor = [_minor(found, step) for step in found.minor]
    told = {name for m in minor for name in (m["effect"], *(r["effect"] for r in m["rivals"]))}
    told |= {name for c in causes for name in (*c["class"], *(r["effect"] for r in c["rivals"]))}
    rows = [r for r in found.screened if r.hypothesis.name not in told]
    left, drifting = lack_of_fit(found.end, names), drifts(found.end, names)
    learned = residual is not None and bool(residual.found.causes)
    lacking = learned or bool(found.withdrawn) or any(row.lacking for row in (*left, *drifting))
    lacking = lacking or any(c["motions_disagree"] for c in causes)
    doubtful = [r["effect"] for m in minor for r in m["rivals"]]
    stable = all(row.stable for row in left)
    verdict = _verdict(found, causes, lacking, stable, bool(doubtful or found.end.model.strained))
    content = {
        "verdict": verdict,
        "causes": causes,
        "given": _given(found, names),
        "minor": minor,
        "ruled_out": [r.hypothesis.name for r in rows if r.decision == "absent"],
        "wrong_sign": [r.hypothesis.name for r in rows if r.wrong_sign],
        "undecided": [*doubtful, *(r.hypothesis.name for r in rows if r.decision in ("inconclusive", "present"))],
        "unresolvable": [
            {"effect": r.hypothesis.name, "smallest_detectable": _finite(r.detectable), "unit": r.hypothesis.unit}
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
        "warnings": warnings_of(found, names, left),
        "motions": list(names),
    }
    return Diagnosis(verdict, content, found, missing, residual)


def refused(faults: Sequence[Fault], names: Sequence[str] = ()) -> Diagnosis:
    """The answer where episodes cannot be believed: what is wrong with them."""
    keys = "causes given minor ruled_out wrong_sign undecided unresolvable lack_of_fit drifts warnings"
    lists: dict[str, Any] = {key: [] for key in keys.split()}
    none = dict.fromkeys(("gain", "missing_force", "residual", "next_experiment", "model", "plan_hash"))
    said = [{"episode": f.episode, "what": f.what, "remedy": f.remedy} for f in faults]
    content = {**lists, **none, "verdict": "invalid_data", "also_unexplained": False, "parameters": {}}
    return Diagnosis("invalid_data", {**content, "faults": said, "motions": list(names)}, None)


def _verdict(found: Found, causes: Sequence[dict[str, Any]], lacking: bool, stable: bool, doubtful: bool) -> Verdict:
    if causes:
        return "identified" if all(not c["rivals"] and len(c["class"]) == 1 for c in causes) else "ambiguous"
    if lacking:
        return "unexplained"
    if not stable:
        return "numerics"
    undecided = [r for r in found.screened if r.decision == "present"]
    return "inconclusive" if undecided or doubtful else "adequate"


def _minor(found: Found, step: Step) -> dict[str, Any]:
    """What is too small to matter, and what cannot be told from it and would matter."""
    alike = found.alike(step)
    small = next(pair for pair in alike if not pair[0].matters(pair[1]))
    return {**_told(*small), "rivals": [_told(h, a) for h, a in alike if h.matters(a)]}


def _told(hypothesis: Hypothesis, amplitude: float) -> dict[str, Any]:
    return {"effect": hypothesis.name, "amplitude": amplitude, "unit": hypothesis.unit}


def _given(found: Found, names: Sequence[str]) -> list[dict[str, Any]]:
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


def _cause(found: Found, step: Step, names: Sequence[str]) -> dict[str, Any]:
    best, h, count = step.best, step.best.hypothesis, len(found.end.model.parameters)
    place, amplitude = found.end.model.place(h.name), found.amplitude(step)
    noise, std, told = _error(found, count + place, names, best.alone)
    noise, std = (math.hypot(error, best.row.bias) for error in (noise, std))
    std = _with_common(std, amplitude)
    kin = [r.hypothesis.name for r in found.unseen(step)]
    rivals = found.rivals(step)
    kin += [c.hypothesis.name for c in rivals if fitted_alike(best.fitted, c.fitted, step.noise)]
    return {
        **_told(h, amplitude),
        "ci95": [amplitude - NORMAL * std, amplitude + NORMAL * std],
        "noise_ci95": [amplitude - NORMAL * noise, amplitude + NORMAL * noise],
        "told_by": told,
        "motions_disagree": _disagreed(found, count + place, told, names),
        "typical": h.typical,
        "says": meaning(h),
        "class": sorted({h.name, *kin, *h.kin}),
        "rivals": [_told(c.hypothesis, c.amplitude) for c in rivals],
        "gain_mm": 1e3 * (best.gain.before - best.gain.after),
        "placebo": {"log_density": step.placebo.gain, "chance": step.placebo.chance or None},
        "share_of_explainable": _share(found, best.gain),
        **shown(found.end, h.name, names, found.setting.episodes),
    }


def _errors(found: Found, names: Sequence[str]) -> Tensor:
    """[P + A] standard errors of the model's coordinates: the wider of what noise allows and motions disagree by.

    Few motions know little of what they disagree by: NORMAL of these errors is as wide as Student's interval.
    """
    own = found.end.covariance.diagonal().sqrt()
    wider = between_motions(heard(found.end.white.episode, names)) / NORMAL
    return torch.maximum(own, wider * spread(found.end, names)[1]) if wider < math.inf else own


def _error(found: Found, place: int, names: Sequence[str], alone: Collection[str]) -> tuple[float, float, float]:
    """Of one coordinate: (standard error by noise alone, as ``_errors``, how many motions tell of it).

    Where hardly more than one does, little is known of what motions disagree by.
    """
    own = float(found.end.covariance[place, place]) ** 0.5
    motions, count = (told_by(found.end, place, names, halved) for halved in ((), alone))
    if count <= 1.0:
        return own, own, motions
    wider = float(stdtrit(max(count - 1.0, 1.0), 0.975)) / NORMAL
    return own, max(own, wider * float(spread(found.end, names, alone)[1][place])), motions


def _disagreed(found: Found, place: int, told: float, names: Sequence[str]) -> bool:
    """Motions differ about a number by more than noise makes them: what it stands for is not quite what happens.

    Cochran's Q: ``told`` - 1 times the ratio of the two variances, against chi^2 of as many degrees of freedom.
    """
    if told < TWO:
        return False
    ratio = float(spread(found.end, names)[1].square()[place] / found.end.covariance[place, place])
    return bool(chdtrc(told - 1.0, (told - 1.0) * ratio) < DISAGREE)


def _with_common(std: float, number: float) -> float:
    return math.hypot(std, COMMON * number)


def _share(found: Found, gain: Gain) -> float | None:
    """Of what all causes explain together, by what each adds to the predictive density."""
    every = sum(max(0.0, step.best.gain.density) for step in found.steps)
    if found.whole is None or not every:
        return None
    return max(0.0, found.whole.explained) * max(0.0, gain.density) / every


def _gain(found: Found, names: Sequence[str]) -> dict[str, Any] | None:
    if found.whole is None:
        return None
    g, motions = found.whole, by_motion(*found.held_out, found.floor, names)
    return {
        "rms_before": g.before,
        "rms_after": g.after,
        "floor": found.floor,
        "unit": "m",
        "explained_fraction": g.explained,
        "ci95": list(g.explained_ci95),
        "log_density": g.density,
        "log_density_ci95": list(g.ci95),
        "per_motion": [
            {
                "motion": name,
                "rms_before": or_none(m.before),
                "rms_after": or_none(m.after),
                "explained_fraction": None if math.isnan(m.before) else m.explained,
                "ci95": None if math.isnan(m.before) or m.least == -math.inf else list(m.explained_ci95),
                "log_density": m.density,
                "log_density_ci95": None if m.least == -math.inf else list(m.ci95),
            }
            for name, m in motions.items()
        ],
    }


def _floor(found: Found) -> dict[str, Any]:
    """What a true model would leave of a cell, and where that is known from."""
    out: dict[str, Any] = {"value": found.floor, "sensor": found.sensor, "unit": "m", "left_out": found.left_out}
    if found.repeats is None:
        return {**out, "source": "sensor only", "pairs": 0}
    return {**out, "source": "repetitions", "pairs": found.repeats.pairs}


def _parameters(found: Found, names: Sequence[str]) -> dict[str, Any]:
    model, out = found.end.model, {}
    for p, c, s in zip(model.parameters, model.values.tolist(), _errors(found, names).tolist(), strict=False):
        value, slope = p.value(c), (p.value(c + NUDGE) - p.value(c - NUDGE)) / (2 * NUDGE)
        wide = NORMAL * _with_common(s, value / slope)
        ends = (p.value(min(max(end, p.low), p.high)) for end in (c - wide, c + wide))
        out[p.name] = {"value": value, "ci95": sorted(ends), "unit": p.unit, "data_sheet": p.value(0.0)}
    return out


def _finite(value: float) -> float | None:
    return value if value < float("inf") else None
