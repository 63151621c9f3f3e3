"""From a search to an answer in words and numbers."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from ..errors import InvalidInput
from .classes import alike
from .comparison import Gain, spread
from .drifting import drifts
from .gate import Fault
from .glossary import GLOSSARY
from .lacking import Left, lack_of_fit
from .missing import MissingForce
from .residual import Residual
from .screening import MUCH, Row
from .stepwise import PLAUSIBLE, Candidate, Found, Step, matters
from .world import Model

Verdict = Literal["identified", "ambiguous", "unexplained", "adequate", "inconclusive", "numerics", "invalid_data"]
NORMAL = 1.96
NEARLY = 0.9  # of the largest amplitude that is believed: fits end a little beyond what slopes ask for


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
    """

    verdict: Verdict
    content: dict[str, Any]
    searched: Found | None
    missing: MissingForce | None = None
    residual: Residual | None = None

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
        return "\n".join(_sentences(self.verdict, self.content))


def judge(
    found: Found, names: Sequence[str], missing: MissingForce | None = None, residual: Residual | None = None
) -> Diagnosis:
    """The answer of a search over episodes with these motions, and of what was learned beyond it."""
    causes = [_cause(found, step, names) for step in found.causes]
    minor = [_minor(found, step) for step in found.minor]
    told = {name for m in minor for name in (m["effect"], *(r["effect"] for r in m["rivals"]))}
    told |= {name for c in causes for name in (*c["class"], *(r["effect"] for r in c["rivals"]))}
    rows = [r for r in found.screened if r.hypothesis.name not in told]
    left, drifting = lack_of_fit(found.end, names), drifts(found.end)
    learned = residual is not None and bool(residual.found.causes)
    lacking = learned or bool(found.withdrawn) or any(row.lacking for row in (*left, *drifting))
    doubtful = [r["effect"] for m in minor for r in m["rivals"]]
    stable = all(row.stable for row in left)
    verdict = _verdict(found, causes, lacking, stable, bool(doubtful or found.end.model.strained))
    content = {
        "verdict": verdict,
        "causes": causes,
        "minor": minor,
        "ruled_out": [r.hypothesis.name for r in rows if r.decision == "absent"],
        "undecided": [*doubtful, *(r.hypothesis.name for r in rows if r.decision in ("inconclusive", "present"))],
        "unresolvable": [
            {"effect": r.hypothesis.name, "smallest_detectable": _finite(r.detectable), "unit": r.hypothesis.unit}
            for r in rows
            if r.decision == "unresolvable"
        ],
        "gain": _gain(found) if causes else None,
        "also_unexplained": bool(causes) and lacking,
        "floor": _floor(found),
        "lack_of_fit": [row.as_dict() for row in left],
        "drifts": [row.as_dict() for row in drifting],
        "missing_force": None if missing is None else missing.as_dict(),
        "residual": None if residual is None else residual.as_dict(),
        "next_experiment": None,
        "parameters": _parameters(found, names),
        "warnings": _warnings(found, names, left),
        "motions": list(names),
    }
    return Diagnosis(verdict, content, found, missing, residual)


def refused(faults: Sequence[Fault], names: Sequence[str] = ()) -> Diagnosis:
    """The answer where episodes cannot be believed: what is wrong with them."""
    lists: dict[str, Any] = {
        key: []
        for key in ("causes", "minor", "ruled_out", "undecided", "unresolvable", "lack_of_fit", "drifts", "warnings")
    }
    none = dict.fromkeys(("gain", "missing_force", "residual", "next_experiment", "model"))
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
    """What is too small to matter, and those of its rivals that would matter."""
    h, rivals = step.best.hypothesis, [_rival(c) for c in step.rivals if matters(c.hypothesis, c.amplitude)]
    return {"effect": h.name, "amplitude": found.amplitude(step), "unit": h.unit, "rivals": rivals}


def _rival(c: Candidate) -> dict[str, Any]:
    return {"effect": c.hypothesis.name, "amplitude": c.amplitude, "unit": c.hypothesis.unit}


def _cause(found: Found, step: Step, names: Sequence[str]) -> dict[str, Any]:
    best, h, count = step.best, step.best.hypothesis, len(found.end.model.parameters)
    place, amplitude = found.end.model.place(h.name), found.amplitude(step)
    std = (float(_errors(found, names, best.alone)[count + place]) ** 2 + best.row.bias**2) ** 0.5
    beaten = {c.hypothesis.name for c in step.tried} - {c.hypothesis.name for c in step.rivals}
    others = [r for r in step.screened if r.gain > 0 and r.hypothesis.name not in beaten]
    kin = [r.hypothesis.name for r in alike(step.before, best.row, others)]
    return {
        "effect": h.name,
        "amplitude": amplitude,
        "unit": h.unit,
        "ci95": [amplitude - NORMAL * std, amplitude + NORMAL * std],
        "class": sorted({h.name, *kin, *h.kin}),
        "rivals": [_rival(c) for c in step.rivals],
        "gain_mm": 1e3 * (best.gain.before - best.gain.after),
        "placebo": {"log_density": step.placebo.gain, "chance": step.placebo.chance},
        "share_of_explainable": _share(found, best.gain),
    }


def _errors(found: Found, names: Sequence[str], alone: Collection[str] = ()) -> Tensor:
    """[P + A] standard errors of the model's coordinates: the wider of what noise allows and motions disagree by."""
    return torch.maximum(found.end.covariance.diagonal().sqrt(), spread(found.end, names, alone)[1])


def _share(found: Found, gain: Gain) -> float | None:
    """Of what all causes explain together, by what each adds to the predictive density."""
    every = sum(step.best.gain.density for step in found.steps)
    return None if found.whole is None else min(1.0, found.whole.explained) * gain.density / every


def _gain(found: Found) -> dict[str, Any] | None:
    if found.whole is None:
        return None
    g = found.whole
    return {
        "rms_before": g.before,
        "rms_after": g.after,
        "floor": found.floor,
        "unit": "m",
        "explained_fraction": g.explained,
        "ci95": list(g.explained_ci95),
        "log_density": g.density,
        "log_density_ci95": list(g.ci95),
    }


def _floor(found: Found) -> dict[str, Any]:
    """What a true model would leave of a cell, and where that is known from."""
    out: dict[str, Any] = {"value": found.floor, "sensor": found.sensor, "unit": "m", "left_out": found.left_out}
    if found.repeats is None:
        return {**out, "source": "sensor only", "pairs": 0}
    return {**out, "source": "repetitions", "pairs": found.repeats.pairs}


def _parameters(found: Found, names: Sequence[str]) -> dict[str, Any]:
    model, std = found.end.model, _errors(found, names).tolist()
    return {
        p.name: {
            "value": p.value(c),
            "ci95": sorted([p.value(c - NORMAL * s), p.value(c + NORMAL * s)]),
            "unit": p.unit,
        }
        for p, c, s in zip(model.parameters, model.values.tolist(), std, strict=False)
    }


def _warnings(found: Found, names: Sequence[str], left: Sequence[Left]) -> list[str]:
    out = [
        f"{p.name} is {far:.1f} standard deviations from its data sheet: it does another's job"
        for p, far in found.end.model.strained
    ]
    if found.repeats is None:
        out.append("floor: sensor only; no episode repeats another, so what repetitions differ by is not known")
    if "bending" not in found.start.model.base.cloth.effects:
        out.append(
            "the data sheet says no bending stiffness: the model's cloth has none, and nothing is asked about it"
        )
    if found.withdrawn:
        out.append(f"one local law predicts much better than {', '.join(found.withdrawn)}: withdrawn")
    if found.left_out:
        out.append(f"{100 * found.left_out:.1f} % of the cells jump between shapes of the cloth and are left out")
    folded = sorted({row.motion for row in left if not row.stable})
    if folded:
        out.append(f"the cloth folds in another way on another mesh in {', '.join(folded)}: no judgement there")
    if not found.causes and any(row.lacking for row in left):
        out += [_too_large(row) for row in found.screened if _is_too_large(row)][:1]
    if len(set(names)) < 3:
        out.append(f"{len(set(names))} kind(s) of motion: many causes look alike in them")
    if len(names) < 8:
        out.append(f"{len(names)} episodes show little of their own spread: intervals of the gain are doubled")
    return out


def _is_too_large(row: Row) -> bool:
    """It would mend much, if it were believed."""
    asked = max(abs(row.amplitude), abs(row.reached))
    return row.shows and row.worth > MUCH and asked > NEARLY * PLAUSIBLE * abs(row.hypothesis.typical)


def _too_large(row: Row) -> str:
    h = row.hypothesis
    return (
        f"{h.name} asks for {row.amplitude:.2g} {h.unit}, and more than {abs(PLAUSIBLE * h.typical):.2g} is not "
        "believed: where that may be so, register a cause with a larger typical amplitude"
    )


def _finite(value: float) -> float | None:
    return value if value < float("inf") else None


def _sentences(verdict: Verdict, content: dict[str, Any]) -> list[str]:
    gain, out = content["gain"], []
    if gain:
        out.append(
            f"On motions held out the simulation is {1e3 * gain['rms_before']:.2f} mm RMS off, "
            f"{1e3 * gain['rms_after']:.2f} mm with the causes below; {1e3 * gain['floor']:.2f} mm would be expected "
            f"({content['floor']['source']})."
        )
    for c in content["causes"]:
        low, high = c["ci95"]
        out.append(f"Cause: {c['effect']} = {c['amplitude']:.4g} {c['unit']} (95 %: {low:.4g} to {high:.4g}).")
        others = [name for name in c["class"] if name != c["effect"]] + [r["effect"] for r in c["rivals"]]
        out += [f"  {said}" for said in (GLOSSARY.get(c["effect"].partition("[")[0]),) if said]
        if others:
            out.append(f"  Cannot be told from: {', '.join(dict.fromkeys(others))}.")
    if content["causes"]:
        out.append(
            "These intervals know of noise, meshes and how far motions disagree, not of what is wrong in all alike."
        )
    words = {
        "adequate": "No known cause is surely larger than what matters.",
        "unexplained": "The fit is lacking, and no known cause mends it.",
        "inconclusive": "Something may be wrong; these data cannot say what.",
        "numerics": "Another mesh changes the motion by more than would be noticed of a cause: use a finer one.",
        "invalid_data": "These episodes cannot be believed; nothing was simulated.",
    }
    if verdict in words:
        out.append(words[verdict])
    out += [f"{f['episode']}: {f['what']}. To do: {f['remedy']}." for f in content.get("faults", ())]
    if content["also_unexplained"]:
        out.append("Something beyond these causes remains unexplained.")
    out += _lacking(content)
    for label, key in (
        ("Too small to matter, or of a sign that makes no sense", "ruled_out"),
        ("Undecided", "undecided"),
    ):
        if content[key]:
            out.append(f"{label}: {', '.join(content[key])}.")
    if content["minor"]:
        out.append(f"In the model, but too small to matter: {', '.join(map(_size, content['minor']))}.")
    for m in content["minor"]:
        if m["rivals"]:
            out.append(f"  These data cannot tell it from {', '.join(map(_size, m['rivals']))}, which would matter.")
    if content["unresolvable"]:
        out.append(f"Cannot be seen in these data: {', '.join(r['effect'] for r in content['unresolvable'])}.")
    if content["next_experiment"]:
        out.append(f"Next experiment: {content['next_experiment']['why']}")
    return [*out, *(f"Warning: {text}." for text in content["warnings"])]


def _size(row: dict[str, Any]) -> str:
    return f"{row['effect']} = {row['amplitude']:.4g} {row['unit']}"


def _lacking(content: dict[str, Any]) -> list[str]:
    """Where the fit is lacking, and what force would mend it."""
    drifting, rows = ([row for row in content[key] if row["lacking"]] for key in ("drifts", "lack_of_fit"))
    told = [
        f"Forces along {d['axis']} drift from the simulation's by {1e3 * d['rate']:.0f} mN/s (standard error "
        f"{1e3 * d['std']:.0f}) in all motions alike: cloth that gains or loses weight, or sensors. Empty grippers, "
        "recorded as long, would tell."
        for d in drifting
    ]
    seen = ", ".join(f"{r['kind']} of {r['motion']} ({r['ratio']:.1f} times what is expected)" for r in rows)
    out = [*told, *([f"Lacking: {seen}."] if rows else [])]
    missing = content["missing_force"] or {"motions": []}
    for m in (m for m in missing["motions"] if m["sure"]):
        where = ", ".join(f"{1e3 * c:.0f}" for c in m["at"])
        size = sum(c * c for c in m["pressure"]) ** 0.5 / missing["weight"]
        out.append(
            f"  A force of {100 * size:.0f} % of the weight is missing in {m['motion']}, about "
            f"({where}) mm of the pattern from {m['from']:.2f} to {m['to']:.2f} s."
        )
    return out + _residual(content["residual"])


def _residual(found: dict[str, Any] | None) -> list[str]:
    """What a learned force does; no cause."""
    if found is None or not found["terms"]:
        return []
    gain, terms = found["gain"], found["terms"]
    told = "; ".join(f"{t['told']} ({abs(t['coefficient']):.2g} {t['unit']})" for t in terms)
    before, after = 1e3 * gain["rms_before"], 1e3 * gain["rms_after"]
    return [f"  A force that {told} would mend {before:.2f} to {after:.2f} mm on motions held out. It names no cause."]
