"""Which fabric is it? From the trials of ``fabrics``: each is left out in turn and given to the nearest fabric.

Nearest by Mahalanobis distance in the identified parameters; its covariance is the trial's own error, the spread of the
fabric's other trials beyond their errors, and the error of their mean. ``--out`` may be the folder of ``fabrics``:
trials that it holds are not repeated.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from torchcloth._utils.files import write_text

from ..resumable import ResumableStudy
from . import classification_figures
from .fabric_tables import table
from .fabric_trials import PAIR, stretches
from .fabrics import LABEL, add, chosen
from .paper_fabrics import CLAIM, FABRICS

FEWEST = 2  # other trials of a fabric, for a mean and a spread
SETS = {"E and ν": PAIR, "E alone": PAIR[:1], "ν alone": PAIR[1:]}
UNLIKELY = {1: 3.84, 2: 5.99}  # squared distance that one in twenty exceeds (chi squared, by the number of parameters)

__all__ = ["add", "run"]


class Trial(NamedTuple):
    """What a trial says, in coordinates in which errors are normal."""

    fabric: str
    place: np.ndarray  # [P]: log E, logit 2 nu
    error: np.ndarray  # [P] its standard deviation


def run(options: argparse.Namespace) -> None:
    """Compute what is missing, then print, draw and write classify.json."""
    scale = chosen(options)
    cases = ResumableStudy(options.out, scale.settings()).run(stretches(scale))
    results = {title: confusion(_trials(cases.values(), names), scale.fabrics) for title, names in SETS.items()}
    content = {"what": LABEL, "paper": f'"{CLAIM}"; no table, no number', "sets": results}
    write_text(options.out / "classify.json", json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False) + "\n")
    _show(results)
    picture = classification_figures.draw(options.out, _trials(cases.values(), PAIR), results)
    print(f"result:  {options.out / 'classify.json'}\npicture: {picture}")


def _trials(cases: Iterable[Mapping[str, Any]], names: Sequence[str]) -> list[Trial]:
    """Of the cases that know all the parameters."""
    out = []
    for case in cases:
        own = [case["parameters"][name] for name in names]
        if all(e["identifiable"] for e in own):
            pairs = [_normal(name, e["value"], e["std"]) for name, e in zip(names, own, strict=True)]
            out.append(Trial(case["fabric"], *(np.array(column) for column in zip(*pairs, strict=True))))
    return out


def _normal(name: str, value: float, std: float) -> tuple[float, float]:
    """(log, or logit of twice the value for Poisson's ratio; its standard deviation)."""
    if name == "poisson_ratio":
        return float(np.log(value / (0.5 - value))), std * 0.5 / (value * (0.5 - value))
    return float(np.log(value)), std / value


def confusion(trials: Sequence[Trial], fabrics: Sequence[str]) -> dict[str, Any]:
    """Each trial left out and assigned.

    Returns:
        ``matrix`` true fabric -> assigned fabric -> count; ``right`` of the ``trials`` of fabrics with enough others;
        ``within``: how many are so near their own fabric as 95 % should be; ``margin``: least distance from a wrong
        fabric, in standard deviations, over all trials; ``distance`` true fabric -> fabric -> mean distance.
    """
    matrix = {a: dict.fromkeys(fabrics, 0) for a in fabrics}
    distances: dict[str, dict[str, list[float]]] = {a: {b: [] for b in fabrics} for a in fabrics}
    within = judged = 0
    for i, trial in enumerate(trials):
        others = [t for j, t in enumerate(trials) if j != i]
        squared = {name: _squared(trial, [t for t in others if t.fabric == name]) for name in fabrics}
        known = {name: d for name, d in squared.items() if d is not None}
        if trial.fabric not in known:  # the others of its own fabric are too few: it could only be wrong
            continue
        judged += 1
        matrix[trial.fabric][min(known, key=lambda name: known[name])] += 1
        within += known[trial.fabric] <= UNLIKELY[len(trial.place)]
        for name, d in known.items():
            distances[trial.fabric][name].append(d**0.5)
    wrong = [d for a, row in distances.items() for b, own in row.items() if a != b for d in own]
    return {
        "trials": judged,
        "right": sum(matrix[name][name] for name in fabrics),
        "within": int(within),
        "margin": min(wrong) if wrong else None,
        "matrix": matrix,
        "distance": {a: {b: float(np.mean(d)) if d else None for b, d in row.items()} for a, row in distances.items()},
    }


def _squared(trial: Trial, others: Sequence[Trial]) -> float | None:
    """Squared Mahalanobis distance of a trial from a fabric's others; None where these are too few."""
    if len(others) < FEWEST:
        return None
    places, errors = np.stack([t.place for t in others]), np.stack([t.error for t in others])
    spread = np.atleast_2d(np.cov(places.T, ddof=1))
    own, theirs = np.diag(trial.error**2), np.diag((errors**2).mean(0))
    beyond = _positive(spread - theirs)
    off = trial.place - places.mean(0)
    return float(off @ np.linalg.solve(own + beyond + (theirs + beyond) / len(others), off))


def _positive(matrix: np.ndarray) -> np.ndarray:
    """The nearest covariance: negative eigenvalues become zero."""
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * values.clip(min=0)) @ vectors.T


def _show(results: Mapping[str, Mapping[str, Any]]) -> None:
    from rich.console import Console

    console = Console(highlight=False)
    console.width = max(console.width, 118)
    for title, result in results.items():
        headings = [FABRICS[name] for name in result["matrix"]]
        out = table(f"From {title}: each trial left out, and assigned to", "is in truth", *headings, left=1)
        for name, row in result["matrix"].items():
            away = result["distance"][name]
            out.add_row(FABRICS[name], *(_cell(row[other], away[other]) for other in row))
        console.print(out)
        n, margin = result["trials"], result["margin"]
        away = "–" if margin is None else f"{margin:.1f}"
        console.print(
            f"{result['right']} of {n} right; nearest wrong fabric {away} standard deviations away; {result['within']} "
            f"of {n} as near their own as 95 % should be. In brackets: mean distance.\n",
            markup=False,
        )
    console.print(f'The paper says that "{CLAIM}" and gives no table of it.', markup=False)


def _cell(count: int, distance: float | None) -> str:
    return f"{count or '·'}" + ("" if distance is None else f" ({distance:.1f})")
