"""Rates of a hidden round with exact bounds, and the targets that they should reach."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from .hidden_scores import EFFECT_FAMILIES, NULL_FAMILIES

Judged = Mapping[str, Any]
CONFOUNDED_KINDS = (
    "tilt or wind",
    "base or extrinsic",
    "mass without forces",
    "damping or drag",
)  # as in validation.hidden


class Rate(NamedTuple):
    """Number of hits of a number of cases."""

    hits: int
    of: int

    @property
    def share(self) -> float | None:
        """Hits as a fraction; None without cases."""
        return self.hits / self.of if self.of else None

    @property
    def bounds(self) -> tuple[float, float] | None:
        """Exact 95 % interval of Clopper and Pearson; None without cases."""
        if not self.of:
            return None
        from scipy.stats import beta

        low = 0.0 if self.hits == 0 else float(beta.ppf(0.025, self.hits, self.of - self.hits + 1))
        high = 1.0 if self.hits == self.of else float(beta.ppf(0.975, self.hits + 1, self.of - self.hits))
        return low, high


class Target(NamedTuple):
    """One target.

    Attributes:
        label: in words.
        value: a rate or a number.
        must: threshold that has to be reached.
        aim: threshold that should be reached.
        is_minimum: the thresholds are minima, else maxima.
    """

    label: str
    value: Rate | float | None
    must: float
    aim: float
    is_minimum: bool = True

    @property
    def number(self) -> float | None:
        """Point estimate of the figure."""
        return self.value.share if isinstance(self.value, Rate) else self.value

    @property
    def reached(self) -> str:
        """Reached threshold: "aim", "must", "missed", or "" without cases."""
        if self.number is None:
            return ""
        for name, threshold in (("aim", self.aim), ("must", self.must)):
            if (self.number >= threshold) if self.is_minimum else (self.number <= threshold):
                return name
        return "missed"


def select_families(cases: Sequence[Judged], *families: str) -> list[Judged]:
    """Return the cases of these families."""
    return [c for c in cases if c["family"] in families]


def count_rate(cases: Sequence[Any], hit: Callable[[Any], Any]) -> Rate:
    """Count the cases for which ``hit`` is true."""
    return Rate(sum(bool(hit(c)) for c in cases), len(cases))


def compute_targets(cases: Sequence[Judged]) -> list[Target]:
    """Return the targets with their values for scored cases."""
    singles, effects = (
        select_families(cases, "single"),
        [c for c in select_families(cases, *EFFECT_FAMILIES) if not c["no_answer"]],
    )
    sets = [c for c in singles if c["named"]]
    sizes = [size for c in sets for size in c["sizes"]]
    errors = amplitude_errors(cases)
    gains = oracle_gains(cases)
    return [
        Target(
            "nulls with a named cause, or refused",
            count_rate(select_families(cases, *NULL_FAMILIES), lambda c: not c["right"]),
            0.05,
            0.02,
            False,
        ),
        Target(
            "class identified, singles at typical size",
            count_rate(select_amplitude(singles, "1"), _is_identified),
            0.85,
            0.95,
        ),
        Target(
            "class identified, singles at half",
            count_rate(select_amplitude(singles, "0.5"), _is_identified),
            0.60,
            0.80,
        ),
        Target("confident and wrong", count_rate(effects, lambda c: c["wrong"]), 0.05, 0.02, False),
        Target("set holds the truth, where one is named", count_rate(sets, lambda c: c["covered"][0]), 0.95, 0.98),
        Target("mean size of the set", float(np.mean(sizes)) if sizes else None, 2.0, 1.5, False),
        Target("amplitude error, median", float(np.median(errors)) if errors else None, 0.15, 0.08, False),
        Target("gain over the oracle's, median", float(np.median(gains)) if gains else None, 0.80, 0.92),
        Target("both of two effects", count_rate(select_families(cases, "double"), lambda c: c["right"]), 0.60, 0.80),
        Target(
            "confounded, answered as such",
            count_rate(select_families(cases, "confounded"), lambda c: c["right"]),
            0.90,
            0.97,
        ),
        Target(
            "outside the catalogue: unexplained",
            count_rate(select_families(cases, "outside"), lambda c: c["right"]),
            0.75,
            0.90,
        ),
        Target("next experiment resolves", count_rate(_with_proposal(cases), lambda c: c["resolved"]), 0.75, 0.90),
    ]


def select_amplitude(singles: Sequence[Judged], share: str) -> list[Judged]:
    """Return the single effects of one amplitude, as a fraction of the typical one."""
    return [c for c in singles if c["kind"] == share]


def by_effect(cases: Sequence[Judged]) -> dict[str, list[Rate]]:
    """Return rates of identified single effects, by effect: at 0.5, 1 and 1.5 of typical, and of observable ones."""
    singles, out = select_families(cases, "single"), {}
    for name in sorted({c["expected"][0] for c in singles}):
        of_effect = [c for c in singles if c["expected"][0] == name]
        out[name] = [
            count_rate(some, _is_identified)
            for some in (
                *(select_amplitude(of_effect, share) for share in ("0.5", "1", "1.5")),
                select_observable(of_effect),
            )
        ]
    return out


def select_observable(cases: Sequence[Judged]) -> list[Judged]:
    """Return the cases whose effects are all observable."""
    return [c for c in cases if c.get("are_observable") and all(c["are_observable"])]


def _is_identified(c: Judged) -> bool:
    return c["identified"][0]


def _with_proposal(cases: Sequence[Judged]) -> list[Judged]:
    return [c for c in cases if c.get("resolved") is not None]


def compared_amplitudes(cases: Sequence[Judged]) -> list[Mapping[str, Any]]:
    """Return the amplitudes of identified effects that can be compared."""
    return [a for c in select_families(cases, "single", "double") for a in c["amplitudes"] if a is not None]


def amplitude_errors(cases: Sequence[Judged]) -> list[float]:
    """Return the absolute values of the relative errors."""
    return [abs(a["error"]) for a in compared_amplitudes(cases)]


def oracle_gains(cases: Sequence[Judged]) -> list[float]:
    """Return the gains relative to the oracle's, where the oracle gains anything."""
    return [c["gain"] for c in cases if c.get("gain") is not None]


def compute_further_rates(cases: Sequence[Judged]) -> list[tuple[str, Rate | float | None]]:
    """Return further figures, each with its label."""
    singles, doubles, known = (
        select_families(cases, "single"),
        select_families(cases, "double"),
        compared_amplitudes(cases),
    )
    errors, extra = [abs(a["error"]) for a in known], select_families(cases, *EFFECT_FAMILIES)
    random = [c for c in cases if c.get("random_resolved") is not None]
    gains = oracle_gains(cases)
    seen = [c for c in singles if not (c["is_unresolvable"][0] and not c["named"])]
    ways = [way for c in select_families(cases, "single", "double") for way in c["directions_right"] if way is not None]
    confounded = select_families(cases, "confounded")
    return [
        ("class identified, singles at 1.5", count_rate(select_amplitude(singles, "1.5"), _is_identified)),
        (
            "class identified, singles at typical size that show",
            count_rate(select_observable(select_amplitude(singles, "1")), _is_identified),
        ),
        (
            "class identified, singles at half that show",
            count_rate(select_observable(select_amplitude(singles, "0.5")), _is_identified),
        ),
        ("both of two effects that show", count_rate(select_observable(doubles), lambda c: c["right"])),
        (
            "outside the catalogue that show: unexplained",
            count_rate(select_observable(select_families(cases, "outside")), lambda c: c["right"]),
        ),
        ("singles said to be invisible in these data, nothing named", Rate(len(singles) - len(seen), len(singles))),
        ("class identified, singles of all sizes but those", count_rate(seen, _is_identified)),
        ("matched nulls with a named cause", count_rate(select_families(cases, "null"), lambda c: c["named"])),
        ("hard nulls with a named cause", count_rate(select_families(cases, "hard null"), lambda c: c["named"])),
        ("sound episodes called invalid", count_rate([c for c in cases if c["family"] != "fault"], _is_refused)),
        ("one of two effects at least", count_rate(doubles, lambda c: any(c["identified"]))),
        ("named outright: axis and sign are right as well", count_rate(ways, bool)),
        *(
            (f"confounded by {kind}", count_rate([c for c in confounded if c["kind"] == kind], _is_right))
            for kind in CONFOUNDED_KINDS
        ),
        ("an effect is hidden: a cause is named of which nothing is there", count_rate(extra, lambda c: c["spurious"])),
        ("nulls that end as unexplained", count_rate(select_families(cases, *NULL_FAMILIES), _is_unexplained)),
        ("an effect of the catalogue is hidden: unexplained", count_rate(extra, _is_unexplained)),
        ("causes that are none, a case", float(np.mean([c["spurious"] for c in extra])) if extra else None),
        ("amplitude error, 90 % quantile", float(np.quantile(errors, 0.9)) if errors else None),
        ("95 % intervals that hold the amplitude", count_rate(known, lambda a: a["inside"])),
        ("singles and doubles of which a gain can be compared", Rate(len(gains), len(singles) + len(doubles))),
        ("gain over the oracle's, 10 % quantile", float(np.quantile(gains, 0.1)) if gains else None),
        ("gain over the oracle's below zero", count_rate(gains, lambda g: g < 0)),
        (
            "outside the catalogue: a cause alone, and false",
            count_rate(select_families(cases, "outside"), lambda c: c["wrong"]),
        ),
        (
            "faulty recordings called invalid, or their clock",
            count_rate(select_families(cases, "fault"), lambda c: c["right"]),
        ),
        ("a random experiment resolves", count_rate(random, lambda c: c["random_resolved"])),
        (
            "cases without an answer, but faults",
            count_rate([c for c in cases if c["family"] != "fault"], _is_unanswered),
        ),
    ]


def _is_right(c: Judged) -> bool:
    return c["right"]


def _is_unexplained(c: Judged) -> bool:
    return c["unexplained"]


def _is_refused(c: Judged) -> bool:
    return c["verdict"] == "invalid_data"


def _is_unanswered(c: Judged) -> bool:
    return c["no_answer"]
