"""How answers to hidden cases are judged: pure functions of what was hidden and what was answered.

A truth is what validation.hidden.reveal_truth prints; an answer is the content of diagnosis.json, or ``{"refused": text}``
where the command refused the recordings, or ``{"failed": text}`` where it ended otherwise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import permutations
from typing import Any, NamedTuple

Truth = Mapping[str, Any]
Answer = Mapping[str, Any]
WITH_EFFECT = ("single", "double", "confounded", "next experiment")
NULLS = ("null", "hard null")
UNDECIDED = ("unresolvable", "undecided", "inconclusive")
MOVED, PULLED = 3e-4, 10e-3  # m and N, RMS: of an effect that shows


class Wanted(NamedTuple):
    """One hidden effect that should be found."""

    name: str  # the generator's
    names: frozenset[str]  # any of them is right
    amplitude: float  # by the library's sign
    comparable: bool
    hypothesis: str  # the library's name with its axis; "" where it has none


class Named(NamedTuple):
    """One cause of an answer."""

    whole: str  # with its axis
    alike: frozenset[str]  # with what no such data tell from it, itself included
    all: frozenset[str]  # with rivals, too
    amplitude: float
    ci95: tuple[float, float]

    @property
    def best(self) -> str:
        """Without its axis."""
        return effect(self.whole)

    @property
    def alone(self) -> bool:
        """Nothing else is said to be possible."""
        return len(self.all) == 1


def effect(name: str) -> str:
    """A cause's name without its axis."""
    return name.partition("[")[0]


def named(answer: Answer) -> list[Named]:
    """The causes of an answer."""
    found = []
    for cause in answer.get("causes", ()):
        alike = frozenset(map(effect, [cause["effect"], *cause["class"]]))
        rivals = frozenset(effect(r["effect"]) for r in cause["rivals"])
        low, high = cause["ci95"]
        found.append(Named(cause["effect"], alike, alike | rivals, cause["amplitude"], (low, high)))
    return found


def wanted(truth: Truth) -> list[Wanted]:
    """What should be found; what is too small to matter, or beyond the catalogue, is not."""
    if truth["family"] in NULLS:
        return []
    return [
        Wanted(e["name"], frozenset(e["names"]), e["amplitude"] * (e["sign"] or 1.0), bool(e["sign"]), e["hypothesis"])
        for e in truth["effects"]
        if e["names"] and not e["is_enabling"]
    ]


def fine(truth: Truth) -> frozenset[str]:
    """Names that are no error."""
    return frozenset(n for e in truth["effects"] for n in e["names"])


def judged(truth: Truth, answer: Answer) -> dict[str, Any]:
    """One case: what counts in the tables."""
    causes, asked, right = named(answer), wanted(truth), fine(truth)
    out: dict[str, Any] = {
        "family": truth["family"],
        "kind": truth["kind"],
        "hidden": [e["name"] for e in truth["effects"]],
        "verdict": verdict(answer),
        "named": [" | ".join([c.best, *sorted(c.all - {c.best})]) for c in causes],
        "wrong": any(c.alone and c.best not in right for c in causes),
        "spurious": sum(not c.all & right for c in causes),
        "sizes": [len(c.all) for c in causes],
        "no_answer": "refused" in answer or "failed" in answer,
        "unexplained": unexplained(answer),
    }
    if asked:
        found = _matched(causes, asked)
        out |= {
            "sought": [w.name for w in asked],
            "found": [c is not None and bool(c.alike & w.names) for c, w in zip(found, asked, strict=True)],
            "covered": [c is not None for c in found],
            "said_invisible": [_invisible(answer, w) for w in asked],
            "amplitudes": [_amplitude(c, w) for c, w in zip(found, asked, strict=True)],
            "ways": [_way(c, w) for c, w in zip(found, asked, strict=True)],
        }
    return out | {"right": _right(truth, answer, causes, asked, out)}


def shows(truth: Truth, sizes: Sequence[Mapping[str, Any]] | None) -> list[bool] | None:
    """Whether each effect that is there for its own sake changes what is recorded beside what the fabric's numbers do.

    ``sizes`` is what validation.hidden.visibility prints; what is not there moves no cloth and is seen as it is. None: not
    known.
    """
    if sizes is None:
        return None
    left = {row["name"]: row["unexplained_displacement_rms_m"] > MOVED or row["unexplained_force_rms_n"] > PULLED for row in sizes}
    return [left.get(e["name"], True) for e in truth["effects"] if not e["is_enabling"]]


def verdict(answer: Answer) -> str:
    """With the ways not to answer among them."""
    return next((word for word in ("refused", "failed") if word in answer), str(answer.get("verdict")))


def _matched(causes: Sequence[Named], asked: Sequence[Wanted]) -> list[Named | None]:
    """The cause that stands for each effect, one for one: as many as can be by their names, then by classes, then by
    rivals, whatever order they are listed in.
    """

    def grade(found: Sequence[Named | None]) -> tuple[int, int, int]:
        pairs = [(c, w.names) for c, w in zip(found, asked, strict=True) if c is not None]
        sets = (lambda c: {c.best}, lambda c: c.alike, lambda c: c.all)
        return tuple(sum(bool(part(c) & names) for c, names in pairs) for part in sets)  # type: ignore[return-value]

    possible = permutations([*causes, *[None] * len(asked)], len(asked))
    best = max(possible, key=grade)
    return [c if c is not None and c.all & w.names else None for c, w in zip(best, asked, strict=True)]


def _invisible(answer: Answer, w: Wanted) -> bool:
    """The answer says that these data do not show it."""
    return any(effect(row["effect"]) in w.names for row in answer.get("unresolvable", ()))


def _amplitude(cause: Named | None, w: Wanted) -> dict[str, Any] | None:
    """Error as a share, and whether the interval holds the truth; None where they cannot be compared."""
    if cause is None or cause.best not in w.names or not w.comparable:
        return None
    low, high = cause.ci95
    return {"error": cause.amplitude / w.amplitude - 1, "inside": low <= w.amplitude <= high}


def _way(cause: Named | None, w: Wanted) -> bool | None:
    """Along the axis that is hidden, and of the sign; None of what is not named outright."""
    if cause is None or cause.best not in w.names:
        return None
    return cause.whole == w.hypothesis and (not w.comparable or cause.amplitude * w.amplitude > 0)


def _right(truth: Truth, answer: Answer, causes: Sequence[Named], asked: Sequence[Wanted], out: Mapping) -> bool:
    """The family's own question, answered well."""
    family = truth["family"]
    if out["no_answer"] and family != "fault":
        return False
    if family in NULLS:
        return not causes and verdict(answer) != "invalid_data"
    if family == "single":
        return out["found"][0]
    if family == "double":
        return all(out["found"])
    if family == "outside":
        return unexplained(answer)
    if family == "fault":
        return verdict(answer) == "invalid_data" or _only(causes, truth["right_for_fault"])
    return said_alike(truth, answer, causes)


def unexplained(answer: Answer) -> bool:
    """The answer says that something is left over which no known cause mends."""
    return answer.get("verdict") == "unexplained" or bool(answer.get("also_unexplained"))


def _only(causes: Sequence[Named], names: Sequence[str]) -> bool:
    return bool(causes) and all(c.best in names for c in causes)


def said_alike(truth: Truth, answer: Answer, causes: Sequence[Named]) -> bool:
    """A confounded case is answered as such.

    Either the effect is named with something else beside it, and nothing false alone; or nothing is named and the
    effect is among what these data cannot decide. Where the data might tell after all, its name alone is right, too.
    """
    names, like = frozenset(n for w in wanted(truth) for n in w.names), truth["confounded"] or {}
    if not causes:
        listed = [row["effect"] if isinstance(row, Mapping) else row for k in UNDECIDED for row in answer.get(k, ())]
        return any(effect(name) in names for name in listed)
    if any(c.alone and c.best not in fine(truth) for c in causes):
        return False
    return any(c.all & names and (len(c.all) > 1 or like.get("may_be_separable", False)) for c in causes)


def told_apart(truth: Truth, answer: Answer) -> bool:
    """The effect is named alone, and nothing false is."""
    names, causes = frozenset(n for w in wanted(truth) for n in w.names), named(answer)
    false = any(c.alone and c.best not in fine(truth) for c in causes)
    return not false and any(c.alone and c.best in names for c in causes)
