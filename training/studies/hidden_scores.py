"""Scores of answers to hidden cases: pure functions of the truth and the answer.

A truth is what ``validation.hidden.reveal_truth`` prints. An answer is the content of diagnosis.json. It is
``{"refused": text}`` if the command refused the recordings, and ``{"failed": text}`` if it ended otherwise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import permutations
from typing import Any, NamedTuple

Truth = Mapping[str, Any]
Answer = Mapping[str, Any]
EFFECT_FAMILIES = ("single", "double", "confounded", "next experiment")
NULL_FAMILIES = ("null", "hard null")
UNDECIDED_KEYS = ("unresolvable", "undecided", "inconclusive")
MIN_DISPLACEMENT_RMS_M = 3e-4  # of an observable effect
MIN_FORCE_RMS_N = 10e-3  # of an observable effect


class ExpectedEffect(NamedTuple):
    """One hidden effect that should be identified.

    Attributes:
        name: in the generator.
        names: any of them is right.
        amplitude: with the library's sign.
        comparable: whether amplitudes of truth and answer can be compared.
        hypothesis: the library's name with its axis; "" if it has none.
    """

    name: str
    names: frozenset[str]
    amplitude: float
    comparable: bool
    hypothesis: str


class NamedCause(NamedTuple):
    """One cause of an answer.

    Attributes:
        hypothesis: name with its axis.
        confounded: the cause and all that no such data distinguish from it.
        candidates: these and the rivals.
        amplitude: in the library's unit.
        ci95: 95 % interval of the amplitude.
    """

    hypothesis: str
    confounded: frozenset[str]
    candidates: frozenset[str]
    amplitude: float
    ci95: tuple[float, float]

    @property
    def name(self) -> str:
        """Name without the axis."""
        return effect(self.hypothesis)

    @property
    def stands_alone(self) -> bool:
        """Tell whether the answer says that nothing else is possible."""
        return len(self.candidates) == 1


def effect(name: str) -> str:
    """Return a cause's name without its axis."""
    return name.partition("[")[0]


def list_named_causes(answer: Answer) -> list[NamedCause]:
    """Return the causes of an answer."""
    out = []
    for cause in answer.get("causes", ()):
        confounded = frozenset(map(effect, [cause["effect"], *cause["equivalence_class"]]))
        rivals = frozenset(effect(r["effect"]) for r in cause["rivals"])
        low, high = cause["ci95"]
        out.append(NamedCause(cause["effect"], confounded, confounded | rivals, cause["amplitude"], (low, high)))
    return out


def list_expected_effects(truth: Truth) -> list[ExpectedEffect]:
    """Return the effects that should be identified: not those that are irrelevant or outside the catalogue."""
    if truth["family"] in NULL_FAMILIES:
        return []
    return [
        ExpectedEffect(
            e["name"], frozenset(e["names"]), e["amplitude"] * (e["sign"] or 1.0), bool(e["sign"]), e["hypothesis"]
        )
        for e in truth["effects"]
        if e["names"] and not e["is_enabling"]
    ]


def true_names(truth: Truth) -> frozenset[str]:
    """Return the names that are not an error."""
    return frozenset(n for e in truth["effects"] for n in e["names"])


def score_case(truth: Truth, answer: Answer) -> dict[str, Any]:
    """Score one case; return what the tables count."""
    causes, expected, right = list_named_causes(answer), list_expected_effects(truth), true_names(truth)
    out: dict[str, Any] = {
        "family": truth["family"],
        "kind": truth["kind"],
        "hidden": [e["name"] for e in truth["effects"]],
        "verdict": outcome(answer),
        "named": [" | ".join([c.name, *sorted(c.candidates - {c.name})]) for c in causes],
        "wrong": any(c.stands_alone and c.name not in right for c in causes),
        "spurious": sum(not c.candidates & right for c in causes),
        "sizes": [len(c.candidates) for c in causes],
        "no_answer": "refused" in answer or "failed" in answer,
        "unexplained": is_unexplained(answer),
    }
    if expected:
        matches = match_causes(causes, expected)
        out |= {
            "expected": [w.name for w in expected],
            "identified": [
                c is not None and bool(c.confounded & w.names) for c, w in zip(matches, expected, strict=True)
            ],
            "covered": [c is not None for c in matches],
            "is_unresolvable": [_is_unresolvable(answer, w) for w in expected],
            "amplitudes": [_amplitude(c, w) for c, w in zip(matches, expected, strict=True)],
            "directions_right": [_is_direction_right(c, w) for c, w in zip(matches, expected, strict=True)],
        }
    return out | {"right": _is_right(truth, answer, causes, expected, out)}


def observable_effects(truth: Truth, sizes: Sequence[Mapping[str, Any]] | None) -> list[bool] | None:
    """Tell whether each effect changes the recording by more than a change of the fabric's parameters could explain.

    Effects that only enable another one are left out.

    Args:
        truth: of the case.
        sizes: output of ``validation.hidden.visibility``. Effects that it does not list move no cloth, so they count as
            observable. None: not known.
    """
    if sizes is None:
        return None
    is_observable = {
        row["name"]: row["unexplained_displacement_rms_m"] > MIN_DISPLACEMENT_RMS_M
        or row["unexplained_force_rms_n"] > MIN_FORCE_RMS_N
        for row in sizes
    }
    return [is_observable.get(e["name"], True) for e in truth["effects"] if not e["is_enabling"]]


def outcome(answer: Answer) -> str:
    """Return the verdict, or "refused" or "failed" if there is no answer."""
    return next((word for word in ("refused", "failed") if word in answer), str(answer.get("verdict")))


def match_causes(causes: Sequence[NamedCause], expected: Sequence[ExpectedEffect]) -> list[NamedCause | None]:
    """Match each effect with at most one cause.

    As many as possible match by name, then by confounded names, then by rivals. The order of the lists is irrelevant.
    """

    def grade(matches: Sequence[NamedCause | None]) -> tuple[int, int, int]:
        pairs = [(c, w.names) for c, w in zip(matches, expected, strict=True) if c is not None]
        sets = (lambda c: {c.name}, lambda c: c.confounded, lambda c: c.candidates)
        return tuple(sum(bool(part(c) & names) for c, names in pairs) for part in sets)  # type: ignore[return-value]

    possible = permutations([*causes, *[None] * len(expected)], len(expected))
    best = max(possible, key=grade)
    return [c if c is not None and c.candidates & w.names else None for c, w in zip(best, expected, strict=True)]


def _is_unresolvable(answer: Answer, w: ExpectedEffect) -> bool:
    """Tell whether the answer says that these data do not show the effect."""
    return any(effect(row["effect"]) in w.names for row in answer.get("unresolvable", ()))


def _amplitude(cause: NamedCause | None, w: ExpectedEffect) -> dict[str, Any] | None:
    """Return the relative error, and whether the interval contains the truth; None if they cannot be compared."""
    if cause is None or cause.name not in w.names or not w.comparable:
        return None
    low, high = cause.ci95
    return {"error": cause.amplitude / w.amplitude - 1, "inside": low <= w.amplitude <= high}


def _is_direction_right(cause: NamedCause | None, w: ExpectedEffect) -> bool | None:
    """Whether axis and sign are right; None if the effect is not named outright."""
    if cause is None or cause.name not in w.names:
        return None
    return cause.hypothesis == w.hypothesis and (not w.comparable or cause.amplitude * w.amplitude > 0)


def _is_right(
    truth: Truth, answer: Answer, causes: Sequence[NamedCause], expected: Sequence[ExpectedEffect], out: Mapping
) -> bool:
    """Whether the answer is right for the question that the case's family asks."""
    family = truth["family"]
    if out["no_answer"] and family != "fault":
        return False
    if family in NULL_FAMILIES:
        return not causes and outcome(answer) != "invalid_data"
    if family == "single":
        return out["identified"][0]
    if family == "double":
        return all(out["identified"])
    if family == "outside":
        return is_unexplained(answer)
    if family == "fault":
        return outcome(answer) == "invalid_data" or _are_all_among(causes, truth["right_for_fault"])
    return is_answered_as_confounded(truth, answer, causes)


def is_unexplained(answer: Answer) -> bool:
    """Tell whether the answer says that a lack of fit remains which no known cause explains."""
    return answer.get("verdict") == "unexplained" or bool(answer.get("also_unexplained"))


def _are_all_among(causes: Sequence[NamedCause], names: Sequence[str]) -> bool:
    return bool(causes) and all(c.name in names for c in causes)


def is_answered_as_confounded(truth: Truth, answer: Answer, causes: Sequence[NamedCause]) -> bool:
    """Tell whether a confounded case is answered as such.

    Either the effect is named together with another candidate, and no false cause stands alone. Or nothing is named,
    and the effect is listed among those that these data cannot decide. If the data may separate the two after all, the
    effect's name alone is also right.
    """
    names, confounding = frozenset(n for w in list_expected_effects(truth) for n in w.names), truth["confounded"] or {}
    if not causes:
        listed = [
            row["effect"] if isinstance(row, Mapping) else row for k in UNDECIDED_KEYS for row in answer.get(k, ())
        ]
        return any(effect(name) in names for name in listed)
    if any(c.stands_alone and c.name not in true_names(truth) for c in causes):
        return False
    return any(
        c.candidates & names and (len(c.candidates) > 1 or confounding.get("may_be_separable", False)) for c in causes
    )


def is_resolved(truth: Truth, answer: Answer) -> bool:
    """Tell whether the effect stands alone, and no false cause does."""
    names, causes = frozenset(n for w in list_expected_effects(truth) for n in w.names), list_named_causes(answer)
    false = any(c.stands_alone and c.name not in true_names(truth) for c in causes)
    return not false and any(c.stands_alone and c.name in names for c in causes)
