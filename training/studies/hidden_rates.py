"""Rates of the hidden round with exact bounds, and the marks that they should reach."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from .hidden_scores import NULLS, WITH_EFFECT

Judged = Mapping[str, Any]
CONFOUNDED = ("tilt or wind", "base or extrinsic", "mass without forces", "damping or drag")  # as validation.hidden has them


class Rate(NamedTuple):
    """So many of so many."""

    hits: int
    of: int

    @property
    def share(self) -> float | None:
        """None of nothing."""
        return self.hits / self.of if self.of else None

    @property
    def bounds(self) -> tuple[float, float] | None:
        """Clopper and Pearson's exact 95 % interval."""
        if not self.of:
            return None
        from scipy.stats import beta

        low = 0.0 if self.hits == 0 else float(beta.ppf(0.025, self.hits, self.of - self.hits + 1))
        high = 1.0 if self.hits == self.of else float(beta.ppf(0.975, self.hits + 1, self.of - self.hits))
        return low, high


class Mark(NamedTuple):
    """One line of what must show.

    Attributes:
        label: in words.
        value: a Rate, or a plain number.
        must, aim: the marks.
        least: the value should be at least the mark, else at most.
    """

    label: str
    value: Rate | float | None
    must: float
    aim: float
    least: bool = True

    @property
    def number(self) -> float | None:
        """The point estimate."""
        return self.value.share if isinstance(self.value, Rate) else self.value

    @property
    def reached(self) -> str:
        """ "aim", "must", "missed", or "" where there is no case."""
        if self.number is None:
            return ""
        for name, mark in (("aim", self.aim), ("must", self.must)):
            if (self.number >= mark) if self.least else (self.number <= mark):
                return name
        return "missed"


def of(cases: Sequence[Judged], *families: str) -> list[Judged]:
    """The cases of these families."""
    return [c for c in cases if c["family"] in families]


def rate(cases: Sequence[Any], hit: Callable[[Any], Any]) -> Rate:
    """How many of the cases."""
    return Rate(sum(bool(hit(c)) for c in cases), len(cases))


def marks(cases: Sequence[Judged]) -> list[Mark]:
    """What must show, of judged cases."""
    singles, effects = of(cases, "single"), [c for c in of(cases, *WITH_EFFECT) if not c["no_answer"]]
    sets = [c for c in singles if c["named"]]
    sizes = [size for c in sets for size in c["sizes"]]
    errors = amplitude_errors(cases)
    gains = oracles_share(cases)
    return [
        Mark(
            "nulls with a named cause, or refused", rate(of(cases, *NULLS), lambda c: not c["right"]), 0.05, 0.02, False
        ),
        Mark("class identified, singles at typical size", rate(at(singles, "1"), _found), 0.85, 0.95),
        Mark("class identified, singles at half", rate(at(singles, "0.5"), _found), 0.60, 0.80),
        Mark("confident and wrong", rate(effects, lambda c: c["wrong"]), 0.05, 0.02, False),
        Mark("set holds the truth, where one is named", rate(sets, lambda c: c["covered"][0]), 0.95, 0.98),
        Mark("mean size of the set", float(np.mean(sizes)) if sizes else None, 2.0, 1.5, False),
        Mark("amplitude error, median", float(np.median(errors)) if errors else None, 0.15, 0.08, False),
        Mark("gain over the oracle's, median", float(np.median(gains)) if gains else None, 0.80, 0.92),
        Mark("both of two effects", rate(of(cases, "double"), lambda c: c["right"]), 0.60, 0.80),
        Mark("confounded, answered as such", rate(of(cases, "confounded"), lambda c: c["right"]), 0.90, 0.97),
        Mark("outside the catalogue: unexplained", rate(of(cases, "outside"), lambda c: c["right"]), 0.75, 0.90),
        Mark("next experiment resolves", rate(_proposed(cases), lambda c: c["resolved"]), 0.75, 0.90),
    ]


def at(singles: Sequence[Judged], share: str) -> list[Judged]:
    """Singles of one amplitude."""
    return [c for c in singles if c["kind"] == share]


def by_effect(cases: Sequence[Judged]) -> dict[str, list[Rate]]:
    """Singles whose class is identified, by effect: at half, typical and one and a half, and all of them that show."""
    singles, out = of(cases, "single"), {}
    for name in sorted({c["sought"][0] for c in singles}):
        own = [c for c in singles if c["sought"][0] == name]
        out[name] = [rate(some, _found) for some in (*(at(own, share) for share in ("0.5", "1", "1.5")), shown(own))]
    return out


def shown(cases: Sequence[Judged]) -> list[Judged]:
    """Those whose effects all change what is recorded."""
    return [c for c in cases if c.get("shows") and all(c["shows"])]


def _found(c: Judged) -> bool:
    return c["found"][0]


def _proposed(cases: Sequence[Judged]) -> list[Judged]:
    return [c for c in cases if c.get("resolved") is not None]


def amplitudes(cases: Sequence[Judged]) -> list[Mapping[str, Any]]:
    """Of the effects that were found and can be compared."""
    return [a for c in of(cases, "single", "double") for a in c["amplitudes"] if a is not None]


def amplitude_errors(cases: Sequence[Judged]) -> list[float]:
    """Sizes of the relative errors."""
    return [abs(a["error"]) for a in amplitudes(cases)]


def oracles_share(cases: Sequence[Judged]) -> list[float]:
    """Gains over the oracle's, where there was something to be gained."""
    return [c["gain"] for c in cases if c.get("gain") is not None]


def further(cases: Sequence[Judged]) -> list[tuple[str, Rate | float | None]]:
    """What else one should know, by words."""
    singles, doubles, known = of(cases, "single"), of(cases, "double"), amplitudes(cases)
    errors, extra = [abs(a["error"]) for a in known], of(cases, *WITH_EFFECT)
    random = [c for c in cases if c.get("random_resolved") is not None]
    gains = oracles_share(cases)
    seen = [c for c in singles if not (c["said_invisible"][0] and not c["named"])]
    ways = [way for c in of(cases, "single", "double") for way in c["ways"] if way is not None]
    confounded = of(cases, "confounded")
    return [
        ("class identified, singles at 1.5", rate(at(singles, "1.5"), _found)),
        ("class identified, singles at typical size that show", rate(shown(at(singles, "1")), _found)),
        ("class identified, singles at half that show", rate(shown(at(singles, "0.5")), _found)),
        ("both of two effects that show", rate(shown(doubles), lambda c: c["right"])),
        ("outside the catalogue that show: unexplained", rate(shown(of(cases, "outside")), lambda c: c["right"])),
        ("singles said to be invisible in these data, nothing named", Rate(len(singles) - len(seen), len(singles))),
        ("class identified, singles of all sizes but those", rate(seen, _found)),
        ("matched nulls with a named cause", rate(of(cases, "null"), lambda c: c["named"])),
        ("hard nulls with a named cause", rate(of(cases, "hard null"), lambda c: c["named"])),
        ("sound episodes called invalid", rate([c for c in cases if c["family"] != "fault"], _refused)),
        ("one of two effects at least", rate(doubles, lambda c: any(c["found"]))),
        ("named outright: axis and sign are right as well", rate(ways, bool)),
        *((f"confounded by {kind}", rate([c for c in confounded if c["kind"] == kind], _right)) for kind in CONFOUNDED),
        ("an effect is hidden: a cause is named of which nothing is there", rate(extra, lambda c: c["spurious"])),
        ("nulls that end as unexplained", rate(of(cases, *NULLS), _unexplained)),
        ("an effect of the catalogue is hidden: unexplained", rate(extra, _unexplained)),
        ("causes that are none, a case", float(np.mean([c["spurious"] for c in extra])) if extra else None),
        ("amplitude error, 90 % quantile", float(np.quantile(errors, 0.9)) if errors else None),
        ("95 % intervals that hold the amplitude", rate(known, lambda a: a["inside"])),
        ("singles and doubles of which a gain can be compared", Rate(len(gains), len(singles) + len(doubles))),
        ("gain over the oracle's, 10 % quantile", float(np.quantile(gains, 0.1)) if gains else None),
        ("gain over the oracle's below zero", rate(gains, lambda g: g < 0)),
        ("outside the catalogue: a cause alone, and false", rate(of(cases, "outside"), lambda c: c["wrong"])),
        ("faulty recordings called invalid, or their clock", rate(of(cases, "fault"), lambda c: c["right"])),
        ("a random experiment resolves", rate(random, lambda c: c["random_resolved"])),
        ("cases without an answer, but faults", rate([c for c in cases if c["family"] != "fault"], _silent)),
    ]


def _right(c: Judged) -> bool:
    return c["right"]


def _unexplained(c: Judged) -> bool:
    return c["unexplained"]


def _refused(c: Judged) -> bool:
    return c["verdict"] == "invalid_data"


def _silent(c: Judged) -> bool:
    return c["no_answer"]
