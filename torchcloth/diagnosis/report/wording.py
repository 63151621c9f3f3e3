"""Sentences about the content of diagnosis.json, and warnings about a search."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ...episodes.world import WorldModel
from ..data.binning import BLOCK_NAMES, FORCE_BLOCK
from ..decide.criteria import CRITERIA
from ..decide.search import SearchResult
from ..inference.lack_of_fit import LackOfFit
from ..inference.screening import ScoreTest
from ..models.base_model import UNSTATED_PRIOR_STD

IMPLAUSIBLE_FORCE = (
    " Hardly anything exerts such a force. More likely causes are the grip, the measurement, or a fold that turns over."
)
MILLIMETRES = (
    "Millimetres are means over parts of the fabric and 0.2 s, without small errors of clock, camera and grip. Single "
    "points are farther off."
)
SINGLE_MOTION = {
    "adequate": "This holds for this motion only: others may show what it does not.",
    "inconclusive": "One motion cannot confirm a cause, because no other one was held out to predict.",
    "unexplained": "This holds for this motion only, by linearised tests.",
}
FELT_BLOCKS = BLOCK_NAMES[FORCE_BLOCK:]
NO_MASS = (
    "No forces were measured, so the mass itself cannot be determined: cloth that is heavier, and as many times "
    "stiffer and more damped, moves in the same way. The model has the mass of the data sheet."
)
DISAGREEMENT = (
    "Motions disagree about its size by more than noise and mesh errors: the cause is not quite this, or there is more."
)
FLOOR_SOURCES = {"sensor only": "noise floor of the sensor alone", "repetitions": "noise floor of repetitions"}
VERDICTS = {
    "identified": "Each named cause stands alone: no other hypothesis that was asked about explains the same.",
    "ambiguous": "A cause is named, and these data do not distinguish it from others. The extended model has the named "
    "cause, and may predict as the wrong one does.",
    "adequate": "No known cause is surely larger than the smallest effect of interest.",
    "unexplained": "The model has a significant misfit, and no known cause explains it.",
    "inconclusive": "Something may be wrong; these data cannot say what.",
    "numerics": "Another mesh changes the motion by more than a noticeable cause would: use a finer one.",
    "invalid_data": "These episodes cannot be used; nothing was simulated.",
}
REQUESTED_CAUSE_LISTS = {
    "Absent, or below the smallest effect of interest": "ruled_out",
    "Would need a sign that makes no sense": "wrong_sign",
    "Undecided": "undecided",
}
NOT_DETECTABLE, NO_EFFECT = "Not detectable in these data", "No effect here beyond what a fitted parameter does"
SECONDARY_LINES = (*REQUESTED_CAUSE_LISTS, NOT_DETECTABLE, NO_EFFECT)


def write_sentences(verdict: str, content: dict[str, Any]) -> list[str]:
    """Write the result in plain language, one sentence or list a line.

    Args:
        verdict: of the diagnosis.
        content: of diagnosis.json.
    """
    gain, out = content["gain"], []
    if gain:
        out.append(
            f"On held-out motions the simulation is {1e3 * gain['rms_before']:.2f} mm RMS off, and "
            f"{1e3 * gain['rms_after']:.2f} mm with the causes below. The "
            f"{FLOOR_SOURCES[content['noise_floor']['source']]} is {1e3 * gain['noise_floor']:.2f} mm."
        )
        low, high = (100 * end for end in gain["explained_fraction_ci95"])
        density_low, density_high = gain["log_density_ci95"]
        out.append(
            f"The causes explain {100 * gain['explained_fraction']:.0f} % of what can be explained (95 %: {low:.0f} to "
            f"{high:.0f} %), and gain {gain['log_density']:.0f} in log density ({density_low:.0f} to "
            f"{density_high:.0f})."
        )
        out.append(MILLIMETRES)
    out += [f"Came with the model, fitted again: {_amplitude_with_interval(c)}." for c in content["initial_causes"]]
    for c in content["causes"]:
        out += _describe_cause(c, content)
    if content["causes"]:
        out.append(
            "These intervals include noise, mesh errors, disagreement of motions, and "
            f"{100 * CRITERIA.report.common_relative_error:.0f} % for what is wrong in all motions alike, as between "
            "two simulators. For real cloth that may be more."
        )
    out += [VERDICTS[verdict]] if verdict in VERDICTS else []
    if content.get("single_motion"):
        out += [SINGLE_MOTION[verdict]] if verdict in SINGLE_MOTION else []
        out += _describe_in_sample(content["in_sample"])
    out += [f"{f['episode']}: {f['what']}. To do: {f['remedy']}." for f in content.get("faults", ())]
    if content["also_unexplained"]:
        out.append("Something beyond these causes remains unexplained.")
    out += _describe_misfit(content)

    # hypotheses without a name
    for label, key in REQUESTED_CAUSE_LISTS.items():
        names = content[key]
        if key == "ruled_out":
            names = [name for name in names if name not in content["wrong_sign"]]
        out += [f"{label}: {', '.join(names)}."] if names else []
    if _has_no_mass(content):
        out.append(NO_MASS)
    if content["minor"]:
        out.append(
            f"Present, but below the smallest effect of interest: {', '.join(map(_amplitude, content['minor']))}."
        )
    for m in content["minor"]:
        if m["rivals"]:
            out.append(f"  Confounded with {', '.join(map(_amplitude, m['rivals']))}, which would be relevant.")
    for label, is_detectable in ((NOT_DETECTABLE, True), (NO_EFFECT, False)):
        names = [
            r["effect"] for r in content["unresolvable"] if (r["smallest_detectable"] is not None) == is_detectable
        ]
        out += [f"{label}: {', '.join(names)}."] if names else []
    if content["next_experiment"]:
        out.append(f"Next experiment: {content['next_experiment']['why']}{_describe_arms(content['next_experiment'])}")
    return [*out, *(f"Warning: {text}." for text in content["warnings"])]


def label_episodes(content: dict[str, Any]) -> list[str]:
    """Return each episode's motion, with the name or number of the episode if another one has the same motion."""
    motions = content["motions"]
    names = [e["name"] for e in content.get("episodes", [])] or [str(k + 1) for k in range(len(motions))]
    return [m if motions.count(m) == 1 else f"{m} ({name})" for m, name in zip(motions, names, strict=True)]


def _describe_cause(c: dict[str, Any], content: dict[str, Any]) -> list[str]:
    out = [f"Cause: {_amplitude_with_interval(c)}; {abs(c['typical']):.4g} is typical."]
    out += [f"  {c['description']}"] if c["description"] else []

    # where and when it stands out
    when, where, response = c["when"], c["where"], c["response"]
    if "at" in where:
        u, v = (1e3 * coordinate for coordinate in where["at"])
        place = f"at ({u:.0f}, {v:.0f}) mm of the pattern"
    else:
        place = f"in the force on gripper {where['gripper']}"
    out.append(
        f"  Most significant in {label_episodes(content)[when['episode']]} from {when['from']:.1f} to "
        f"{when['to']:.1f} s, {place}: {1e3 * response['value']:.3g} m{response['unit']} beyond what fitted parameters "
        "could do instead."
    )

    # an interval that contains 0
    if c["ci95"][0] * c["ci95"][1] <= 0:
        low, high = c["noise_ci95"]
        certain = "  Its presence is more certain than its size:"
        if low * high <= 0:
            out.append(f"{certain} noise and mesh errors leave the size open.")
        else:
            out.append(
                f"{certain} {c['effective_motions']:.1f} effective motions inform about it, and parts of them disagree "
                f"about its size. By noise and mesh errors alone it would be {low:.4g} to {high:.4g}."
            )
    out += [f"  {DISAGREEMENT}"] if c["motions_disagree"] else []
    rivals = {r["effect"]: f"{_amplitude(r)} in its place" for r in c["rivals"]}
    others = {name: name for name in c["equivalence_class"] if name != c["effect"]} | rivals
    out += [f"  Confounded with: {', '.join(others.values())}."] if others else []
    return out


def _describe_in_sample(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return what would explain a single motion."""
    if not rows:
        return []
    best, *others = rows
    equal, worse = ([_amplitude(row) for row in others if row["explains_as_well"] is flag] for flag in (True, False))
    out = [f"Fits best in sample: {_amplitude(best)}, linearised, {best['expected_gain']:.0f} in log density."]
    out += [f"  It would be explained about equally well by {', or by '.join(equal)}."] if equal else []
    out += [f"  In part by {', or by '.join(worse)}."] if worse else []
    return out


def _describe_arms(experiment: dict[str, Any]) -> str:
    """Return what the arms need for an experiment, and what they cannot do."""
    arms = experiment["arms"]
    if arms is None:
        return ""
    if "not_checked" in arms:
        return f" The arms were not checked: {arms['not_checked']}."
    slowdown, count = arms["slowdown"], len(arms["refused"])
    is_slower = slowdown > CRITERIA.report.min_slowdown
    slower = f" The arms cannot do it faster: it takes {slowdown:.2g} times as long as asked ({arms['limited_by']})."
    refused = f" {count} other{'s are' if count > 1 else ' is'} beyond them."
    return (slower if is_slower else " The arms can do it.") + (refused if count else "")


def _has_no_mass(content: dict[str, Any]) -> bool:
    """Whether no forces were measured and no cause is a mass."""
    kinds = {row["kind"] for row in content["lack_of_fit"]}
    named = {c["effect"] for c in (*content["causes"], *content["initial_causes"])}
    return bool(kinds) and not kinds & set(FELT_BLOCKS) and "mass.density" not in named


def _amplitude(row: dict[str, Any]) -> str:
    unit = "" if row["unit"] == "-" else f" {row['unit']}"
    return f"{row['effect']} = {row['amplitude']:.4g}{unit}"


def _amplitude_with_interval(row: dict[str, Any]) -> str:
    low, high = row["ci95"]
    return f"{_amplitude(row)} (95 %: {low:.4g} to {high:.4g})"


def _describe_misfit(content: dict[str, Any]) -> list[str]:
    """Return where the model has a significant misfit, and which force would explain it."""
    drifts, rows = ([row for row in content[key] if row["is_significant"]] for key in ("force_drifts", "lack_of_fit"))
    out = [_describe_drift(d) for d in drifts]
    out += [f"Misfit: {', '.join(map(_describe_row, rows))}."] if rows else []
    missing = content["missing_force"] or {"motions": [], "weight_pa": 0.0}
    out += [_describe_missing_force(m, missing["weight_pa"]) for m in missing["motions"] if m["is_significant"]]
    unstable = [
        f"{m['motion']} from {m['unstable_from']:.1f} s on"
        for m in missing["motions"]
        if m["unstable_from"] is not None
    ]
    if unstable:
        out.append(
            f"  The missing force cannot be estimated where small forces have unbounded effects: {', '.join(unstable)}."
        )
    return out + _describe_laws(content["residual_force"])


def _describe_drift(d: dict[str, Any]) -> str:
    what = "sensors"
    if d["axis"] == "z":  # cloth that hangs pulls along -z
        what = f"cloth that {'gains' if d['rate'] < 0 else 'loses'} weight, or sensors"
    return (
        f"The force on each gripper along {d['axis']} drifts from the simulation's by {1e3 * d['rate']:.0f} mN/s "
        f"(standard error {1e3 * d['std']:.0f}) in all motions: {what}. A recording of empty grippers, as long as "
        "these, would tell."
    )


def _describe_row(row: dict[str, Any]) -> str:
    """Return a kind of data with a misfit, and its time window if it is a single one."""
    worst, elsewhere = row["worst_window"], ""
    if worst is not None and worst["ratio_elsewhere"] < CRITERIA.adequacy.max_rms_ratio:
        elsewhere = f", {worst['ratio_elsewhere']:.1f} except from {worst['from']:.1f} to {worst['to']:.1f} s"
    return f"{row['kind']} of {row['motion']} ({row['rms_ratio']:.1f} times the expected RMS{elsewhere})"


def _describe_missing_force(m: dict[str, Any], weight_pa: float) -> str:
    place = ", ".join(f"{1e3 * c:.0f}" for c in m["at"])
    size = sum(c * c for c in m["pressure"]) ** 0.5
    direction = ", ".join(f"{c / max(size, 1e-30):.1f}" for c in m["pressure"])
    percent = 100 * size / weight_pa
    remark = IMPLAUSIBLE_FORCE if percent > 100 * CRITERIA.report.max_weight_ratio else ""
    return (
        f"  A pressure of {size:.2g} Pa ({percent:.0f} % of the cloth's own weight) towards ({direction}) of the world "
        f"is missing in {m['motion']}, at about ({place}) mm of the pattern "
        f"from {m['from']:.2f} to {m['to']:.2f} s.{remark}"
    )


def _describe_laws(residual: dict[str, Any] | None) -> list[str]:
    """Return what the learned force laws do."""
    if residual is None or not residual["terms"]:
        return []
    gain = residual["gain"]
    laws = "; ".join(f"{t['description']} ({abs(t['coefficient']):.2g} {t['unit']})" for t in residual["terms"])
    before, after = 1e3 * gain["rms_before"], 1e3 * gain["rms_after"]
    return [
        f"  A force that {laws} would improve {before:.2f} to {after:.2f} mm on held-out motions. It names no cause."
    ]


def collect_warnings(result: SearchResult, motions: Sequence[str], rows: Sequence[LackOfFit]) -> list[str]:
    """Collect what a reader of a result should know.

    Args:
        result: the search.
        motions: label of each episode.
        rows: its lack of fit.
    """
    end, start = result.end.model, result.start.model
    out = [warning for e in result.data.episodes for warning in e.data_warnings()]
    out += [
        f"{p.name} is {stds:.1f} prior standard deviations from its data sheet: it makes up for another effect"
        for p, stds in end.strained_parameters
    ]
    out += warn_of_implied_amplitudes(end)
    if result.replicate_floor is None:
        out.append("the noise floor is the sensor's alone: no episode repeats another one")
    if any(p.name == "youngs_modulus" and p.prior_std > UNSTATED_PRIOR_STD for p in start.parameters):
        out.append("the data sheet states no stiffness in tension: it is searched for over two decades")
    if "bending" not in start.base.cloth.effects:
        out.append(
            "the data sheet states no bending stiffness: the model's cloth has none, and no hypothesis of it is tested"
        )
    if result.not_simulated:
        out.append(f"{', '.join(result.not_simulated)}: could not be simulated here, so nothing is said about it")
    if result.withdrawn:
        withdrawn = ", ".join(result.withdrawn)
        out.append(f"{withdrawn} was withdrawn: a local force law that is no known cause predicts much better")
    if result.bifurcating_fraction:
        percent = 100 * result.bifurcating_fraction
        out.append(f"{percent:.1f} % of the bins have a discontinuous response and are left out")
    folded = sorted({row.motion for row in rows if not row.meshes_agree})
    if folded:
        out.append(f"another mesh folds the cloth differently in {', '.join(folded)}: these motions are not judged")
    out += [
        f"the cloth ripples so much in {row.motion} that a correct model might leave {1e3 * row.expected_rms:.0f} mm "
        f"of {row.kind}: a misfit can hardly be detected there"
        for row in rows
        if row.is_position and row.meshes_agree and row.expected_rms > CRITERIA.report.max_expected_rms_m
    ]
    if not result.causes and any(row.is_significant for row in rows):
        out += [_warn_of_large_amplitude(score) for score in result.scores if _is_implausibly_large(score)][:1]
    if len(set(motions)) < CRITERIA.candidate.min_motions:
        out.append(f"{len(set(motions))} kind(s) of motion: many causes are confounded in them")
    if result.total_gain is not None and result.total_gain.small_sample_episodes:
        out.append(
            f"{result.total_gain.small_sample_episodes} episodes, fewer than eight, say little about their scatter: "
            "the interval of the explained fraction was doubled to be safe"
        )
    return out


def warn_of_implied_amplitudes(model: WorldModel) -> list[str]:
    """Return warnings about amplitudes that count from what another cause implied."""
    causes = list(zip(model.accepted, model.amplitudes, strict=True))
    return [
        f"{h.name} = {amplitude:.3g} comes on top of the {h.typical:g} that {earlier.name} implies"
        for k, (h, amplitude) in enumerate(causes)
        for earlier in [e for e, _ in causes[:k] if e.implies == h.name][:1]
    ]


def _is_implausibly_large(score: ScoreTest) -> bool:
    """Whether a hypothesis would explain much, if its amplitude were plausible."""
    limit = CRITERIA.report.implausible_fraction * CRITERIA.candidate.max_typical * abs(score.hypothesis.typical)
    return (
        score.is_visible and score.expected_gain > CRITERIA.screening.min_expected_gain and abs(score.amplitude) > limit
    )


def _warn_of_large_amplitude(score: ScoreTest) -> str:
    h, limit = score.hypothesis, abs(CRITERIA.candidate.max_typical * score.hypothesis.typical)
    return (
        f"the residuals ask for {h.name} of {score.amplitude:.2g} {h.unit}, and more than {limit:.2g} is implausible: "
        "if it is possible here, register a cause with a larger typical amplitude"
    )


def describe_next_step(verdict: str, content: dict[str, Any]) -> str:
    """Return what to do next, in one or two sentences.

    Args:
        verdict: of the diagnosis.
        content: of diagnosis.json.
    """
    if content.get("next_experiment"):
        motion = content["next_experiment"]["motion"]
        return f"record the proposed motion {motion!r} (folder next_experiment), and diagnose again with it."
    if verdict == "adequate" and content.get("single_motion"):
        return 'use the fitted model, tc.load("base.tcm"), or record another motion and diagnose both.'
    return {
        "identified": "measure the gain on new episodes with `torchcloth confirm base.tcm extended.tcm EPISODE`; "
        'tc.load("extended.tcm") is the corrected cloth.',
        "ambiguous": "measure the gain on new episodes with `torchcloth confirm base.tcm extended.tcm EPISODE`. No "
        "short motion was found that would distinguish the causes.",
        "adequate": 'use the fitted model: tc.load("base.tcm").',
        "unexplained": "look at the misfit and the missing force below, and register the cause that you suspect "
        "(torchcloth.diagnosis.register).",
        "inconclusive": "record other or longer motions of the same cloth, and diagnose again.",
        "numerics": "give the episodes a finer mesh, and diagnose again.",
        "invalid_data": "correct the episodes as said below, and diagnose again.",
    }.get(verdict, "")
