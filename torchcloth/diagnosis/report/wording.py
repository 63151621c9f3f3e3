"""The answer in words: sentences of what diagnosis.json holds, and warnings of a search."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ...episodes.world import Model
from ..data.binning import BLOCK_NAMES, FORCE_BLOCK
from ..decide.candidates import PLAUSIBLE
from ..decide.search import SearchResult
from ..inference.lack_of_fit import TOLERATED, LackOfFit
from ..inference.screening import MUCH, ScoreTest
from ..models.base_model import SILENT

NEARLY = 0.9  # of the largest amplitude that is believed: fits end a little beyond what slopes ask for
RIPPLED = 0.01  # m, that a right model may leave of positions: more says nothing of what is lacking
SLOWER = 1.05  # times as long as asked, that is worth a word
HEAVY = 10.0  # weights of the cloth, that hardly anything pushes with
UNLIKELY = (
    " Hardly anything pushes so much: what is left there is rather of the grip, of what is seen, or of a fold that "
    "turns over."
)
MILLIMETRES = (
    "Millimetres are of means over parts of the fabric and 0.2 s, small errors of clock, camera and grip taken out: "
    "single points are farther off."
)
FELT = BLOCK_NAMES[FORCE_BLOCK:]
NO_MASS = (
    "No forces were measured, so mass itself cannot be told: cloth that is heavier, and as many times stiffer and "
    "braked harder, moves alike. What is said of it is what the data sheet says."
)
DISAGREED = (
    "Motions disagree about its size by more than noise and meshes make them: what happens is not quite this, or there "
    "is more."
)
FLOORS = {"sensor only": "the sensor alone would leave", "repetitions": "repetitions of a command differ by"}


def write_sentences(verdict: str, content: dict[str, Any]) -> list[str]:
    """Plain language, a line each."""
    gain, out = content["gain"], []
    if gain:
        out.append(
            f"On motions held out the simulation is {1e3 * gain['rms_before']:.2f} mm RMS off, "
            f"{1e3 * gain['rms_after']:.2f} mm with the causes below; {1e3 * gain['floor']:.2f} mm is what "
            f"{FLOORS[content['floor']['source']]}."
        )
        low, high = (100 * end for end in gain["ci95"])
        least, most = gain["log_density_ci95"]
        out.append(
            f"That is {100 * gain['explained_fraction']:.0f} % of what could be explained (95 %: {low:.0f} to "
            f"{high:.0f} %), and {gain['log_density']:.0f} in log density ({least:.0f} to {most:.0f})."
        )
        out.append(MILLIMETRES)
    out += [f"Came with the model, fitted anew: {_sized(c)}." for c in content["given"]]
    for c in content["causes"]:
        out.append(f"Cause: {_sized(c)}; {abs(c['typical']):.4g} is typical.")
        sizes = {r["effect"]: f"{_size(r)} in its place" for r in c["rivals"]}
        others = {name: name for name in c["class"] if name != c["effect"]} | sizes
        out += [f"  {c['says']}"] if c["says"] else []
        out.append(f"  {_shown(c, content)}")
        out += _hardly_sized(c)
        out += [f"  {DISAGREED}"] if c["motions_disagree"] else []
        if others:
            out.append(f"  Cannot be told from: {', '.join(others.values())}.")
    if content["causes"]:
        out.append(
            "These intervals know of noise, meshes, how far motions disagree, and 3 % for what is wrong in all alike, "
            "as between two engines: of real cloth that may be more."
        )
    words = {
        "identified": "Each cause that is named stands alone: nothing else that was asked about does the same.",
        "ambiguous": "A cause is named, and these data cannot tell it from others: the extended model, which "
        "has the one that is named, may predict as the wrong one does.",
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
    small = [name for name in content["ruled_out"] if name not in content["wrong_sign"]]
    for label, names in (
        ("Not there, or too small to matter", small),
        ("Would have to be of a sign that makes no sense", content["wrong_sign"]),
        ("Undecided", content["undecided"]),
    ):
        out += [f"{label}: {', '.join(names)}."] if names else []
    if _massless(content):
        out.append(NO_MASS)
    if content["minor"]:
        out.append(f"There, but too small to matter: {', '.join(map(_size, content['minor']))}.")
    for m in content["minor"]:
        if m["rivals"]:
            out.append(f"  These data cannot tell it from {', '.join(map(_size, m['rivals']))}, which would matter.")
    for label, known in (
        ("Cannot be seen in these data", True),
        ("Does nothing here, or what a fitted number does as well", False),
    ):
        names = [r["effect"] for r in content["unresolvable"] if (r["smallest_detectable"] is not None) == known]
        out += [f"{label}: {', '.join(names)}."] if names else []
    if content["next_experiment"]:
        out.append(f"Next experiment: {content['next_experiment']['why']}{_by_arms(content['next_experiment'])}")
    return [*out, *(f"Warning: {text}." for text in content["warnings"])]


def label_episodes(content: dict[str, Any]) -> list[str]:
    """What each episode's motion is called, with the episode's name, or number, where another has the same."""
    motions = content["motions"]
    names = [e["name"] for e in content.get("episodes", [])] or [str(k + 1) for k in range(len(motions))]
    return [m if motions.count(m) == 1 else f"{m} ({name})" for m, name in zip(motions, names, strict=True)]


def _by_arms(experiment: dict[str, Any]) -> str:
    """What the arms need for it, and what they cannot do."""
    arms = experiment["arms"]
    if arms is None:
        return ""
    if "unasked" in arms:
        return f" The arms were not asked: {arms['unasked']}."
    slower = f" The arms cannot do it faster: it takes {arms['slower']:.2g} times as long as asked ({arms['limit']})."
    many = len(arms["refused"])
    refused = f" {many} other{'s are' if many > 1 else ' is'} beyond them."
    return (slower if arms["slower"] > SLOWER else " The arms can do it.") + (refused if many else "")


def _massless(content: dict[str, Any]) -> bool:
    """Nothing was felt, and no cause is a mass."""
    kinds = {row["kind"] for row in content["lack_of_fit"]}
    named = {c["effect"] for c in (*content["causes"], *content["given"])}
    return bool(kinds) and not kinds & set(FELT) and "mass.density" not in named


def _sized(row: dict[str, Any]) -> str:
    low, high = row["ci95"]
    return f"{_size(row)} (95 %: {low:.4g} to {high:.4g})"


def _hardly_sized(c: dict[str, Any]) -> list[str]:
    """Where the interval of what is surely there holds 0."""
    if c["ci95"][0] * c["ci95"][1] > 0:
        return []
    low, high = c["noise_ci95"]
    if low * high <= 0:
        return ["  That it is there is surer than how large it is: noise and meshes leave its size open."]
    return [
        f"  That it is there is surer than how large it is: {c['told_by']:.1f} motions' worth of data tell of it, "
        f"and parts of these disagree about its size. By noise and meshes alone it would be {low:.4g} to {high:.4g}."
    ]


def _shown(c: dict[str, Any], content: dict[str, Any]) -> str:
    """Where and when a cause stands out most."""
    when, where, moves = c["when"], c["where"], c["moves"]
    u, v = (1e3 * s for s in where.get("at", (0.0, 0.0)))
    place = f"at ({u:.0f}, {v:.0f}) mm of the pattern" if "at" in where else f"in what gripper {where['gripper']} feels"
    time = f"{when['from']:.1f} to {when['to']:.1f} s"
    beyond = "beyond what fitted numbers could do instead"
    motion, size = label_episodes(content)[when["episode"]], f"{1e3 * moves['value']:.3g} m{moves['unit']}"
    return f"Surest in {motion} from {time}, {place}: {size} {beyond}."


def _size(row: dict[str, Any]) -> str:
    unit = "" if row["unit"] == "-" else f" {row['unit']}"
    return f"{row['effect']} = {row['amplitude']:.4g}{unit}"


def _lacking(content: dict[str, Any]) -> list[str]:
    """Where the fit is lacking, and what force would mend it."""
    drifting, rows = ([row for row in content[key] if row["lacking"]] for key in ("drifts", "lack_of_fit"))
    told = [
        f"The force on each gripper along {d['axis']} drifts from the simulation's by {1e3 * d['rate']:.0f} mN/s "
        f"(standard error {1e3 * d['std']:.0f}) in all motions alike: {_drifting(d)}sensors. "
        "Empty grippers, recorded as long, would tell."
        for d in drifting
    ]
    out = [*told, *([f"Lacking: {', '.join(map(_left, rows))}."] if rows else [])]
    missing = content["missing_force"] or {"motions": [], "weight": 0.0}
    for m in (m for m in missing["motions"] if m["sure"]):
        where = ", ".join(f"{1e3 * c:.0f}" for c in m["at"])
        size = sum(c * c for c in m["pressure"]) ** 0.5
        share = 100 * size / missing["weight"]
        doubt = UNLIKELY if share > 100 * HEAVY else ""
        out.append(
            f"  A pressure of {size:.2g} Pa ({share:.0f} % of the cloth's own weight) towards "
            f"({', '.join(f'{c / max(size, 1e-30):.1f}' for c in m['pressure'])}) of the world is missing in "
            f"{m['motion']}, about ({where}) mm of the pattern from {m['from']:.2f} to {m['to']:.2f} s.{doubt}"
        )
    unasked = [f"{m['motion']} from {m['until']:.1f} s on" for m in missing["motions"] if m["until"] is not None]
    if unasked:
        out.append(
            f"  What force is missing there cannot be asked: small pushes grow without end in {', '.join(unasked)}."
        )
    return out + _residual(content["residual"])


def _drifting(d: dict[str, Any]) -> str:
    """What it may be: cloth that hangs pulls along -z."""
    if d["axis"] != "z":
        return ""
    return f"cloth that {'gains' if d['rate'] < 0 else 'loses'} weight, or "


def _left(row: dict[str, Any]) -> str:
    """What lacks, and when, if that is one stretch of time."""
    worst, but = row["worst"], ""
    if worst is not None and worst["ratio_elsewhere"] < TOLERATED:
        but = f", {worst['ratio_elsewhere']:.1f} but for {worst['from']:.1f} to {worst['to']:.1f} s"
    return f"{row['kind']} of {row['motion']} ({row['ratio']:.1f} times what is expected{but})"


def _residual(found: dict[str, Any] | None) -> list[str]:
    """What a learned force does; no cause."""
    if found is None or not found["terms"]:
        return []
    gain, terms = found["gain"], found["terms"]
    told = "; ".join(f"{t['told']} ({abs(t['coefficient']):.2g} {t['unit']})" for t in terms)
    before, after = 1e3 * gain["rms_before"], 1e3 * gain["rms_after"]
    return [f"  A force that {told} would mend {before:.2f} to {after:.2f} mm on motions held out. It names no cause."]


def collect_warnings(found: SearchResult, names: Sequence[str], left: Sequence[LackOfFit]) -> list[str]:
    """What a reader of a search over episodes with these motions should mind; ``left`` is its lack of fit."""
    out = [doubt for e in found.data.episodes for doubt in e.data_warnings()]
    out += [
        f"{p.name} is {far:.1f} standard deviations from its data sheet: it does another's job"
        for p, far in found.end.model.strained
    ]
    out += warn_of_implied_amplitudes(found.end.model)
    if found.replicate_floor is None:
        out.append("floor: sensor only; no episode repeats another, so what repetitions differ by is not known")
    if any(p.name == "youngs_modulus" and p.std > SILENT for p in found.start.model.parameters):
        out.append("the data sheet says no stiffness in tension: it is sought over two decades")
    if "bending" not in found.start.model.base.cloth.effects:
        out.append(
            "the data sheet says no bending stiffness: the model's cloth has none, and nothing is asked about it"
        )
    if found.not_simulated:
        out.append(f"{', '.join(found.not_simulated)}: could not be simulated here, so nothing is said of it")
    if found.withdrawn:
        names_of = ", ".join(found.withdrawn)
        out.append(f"{names_of} was withdrawn: a local law that is no known cause predicts much better")
    if found.bifurcating_fraction:
        out.append(f"{100 * found.bifurcating_fraction:.1f} % of the cells jump between shapes of the cloth and are left out")
    folded = sorted({row.motion for row in left if not row.meshes_agree})
    if folded:
        out.append(f"the cloth folds in another way on another mesh in {', '.join(folded)}: no judgement there")
    rippled = [row for row in left if row.is_position and row.meshes_agree and row.expected_rms > RIPPLED]
    out += [
        f"the cloth ripples so much in {row.motion} that a right model might leave {1e3 * row.expected_rms:.0f} mm of "
        f"{row.kind}: little there can be called lacking"
        for row in rippled
    ]
    if not found.causes and any(row.is_significant for row in left):
        out += [_too_large(row) for row in found.scores if _is_too_large(row)][:1]
    if len(set(names)) < 3:
        out.append(f"{len(set(names))} kind(s) of motion: many causes look alike in them")
    if found.total_gain is not None and found.total_gain.small_sample_episodes:
        out.append(
            f"{found.total_gain.small_sample_episodes} episodes, fewer than eight, tell little of how they scatter: the interval of the "
            "explained share was doubled to be safe"
        )
    return out


def warn_of_implied_amplitudes(model: Model) -> list[str]:
    """Amplitudes that count from what another cause brought along."""
    causes = list(zip(model.accepted, model.amplitudes, strict=True))
    return [
        f"{h.name} = {amplitude:.3g} comes on top of the {h.typical:g} that {earlier.name} brought"
        for k, (h, amplitude) in enumerate(causes)
        for earlier in [e for e, _ in causes[:k] if e.implies == h.name][:1]
    ]


def _is_too_large(row: ScoreTest) -> bool:
    """It would mend much, if it were believed."""
    return row.is_visible and row.expected_gain > MUCH and abs(row.amplitude) > NEARLY * PLAUSIBLE * abs(row.hypothesis.typical)


def _too_large(row: ScoreTest) -> str:
    h = row.hypothesis
    return (
        f"{h.name} asks for {row.amplitude:.2g} {h.unit}, and more than {abs(PLAUSIBLE * h.typical):.2g} is not "
        "believed: where that may be so, register a cause with a larger typical amplitude"
    )
