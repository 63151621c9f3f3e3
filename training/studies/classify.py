"""Classify fabrics: each trial of the study ``fabrics`` is left out in turn and assigned to the nearest fabric.

The distance is the Mahalanobis distance in the identified parameters. Its covariance is the sum of the trial's error,
the excess scatter of the fabric's other trials, and the error of their mean. ``--out`` may be the folder of
``fabrics``, whose trials are then not repeated.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..resumable import ResumableStudy, write_result
from . import classification_figures
from .fabric_tables import make_table
from .fabric_trials import MEMBRANE_PARAMETERS, stretch_cases
from .fabrics import STUDY_TEXT, add, choose_scale
from .paper_fabrics import CLAIM, FABRICS

MIN_OTHER_TRIALS = 2  # of a fabric, for mean and scatter
PARAMETER_SETS = {
    "E and ν": MEMBRANE_PARAMETERS,
    "E alone": MEMBRANE_PARAMETERS[:1],
    "ν alone": MEMBRANE_PARAMETERS[1:],
}
CHI2_95 = {1: 3.84, 2: 5.99}  # 95 % quantile of chi squared by the number of parameters

__all__ = ["add", "run"]


class Trial(NamedTuple):
    """Estimates of a trial, in coordinates in which errors are normal.

    Attributes:
        fabric: true fabric.
        place: [P], log E and logit 2 nu.
        error: [P], standard deviation.
    """

    fabric: str
    place: np.ndarray
    error: np.ndarray


def run(options: argparse.Namespace) -> None:
    """Compute the missing cases, then print, draw and write classify.json."""
    scale = choose_scale(options)
    cases = ResumableStudy(options.out, scale.settings()).run(stretch_cases(scale))
    results = {
        title: confusion_matrix(_trials(cases.values(), names), scale.fabrics)
        for title, names in PARAMETER_SETS.items()
    }
    content = {"what": STUDY_TEXT, "paper": f'"{CLAIM}"; no table, no number', "sets": results}
    write_result(options.out / "classify.json", "classify", content)
    _show(results)
    picture = classification_figures.draw(options.out, _trials(cases.values(), MEMBRANE_PARAMETERS), results)
    print(f"result:  {options.out / 'classify.json'}\npicture: {picture}")


def _trials(cases: Iterable[Mapping[str, Any]], names: Sequence[str]) -> list[Trial]:
    """Return the trials in which all parameters are identifiable."""
    out = []
    for case in cases:
        entries = [case["parameters"][name] for name in names]
        if all(e["identifiable"] for e in entries):
            pairs = [_to_normal_coordinates(name, e["value"], e["std"]) for name, e in zip(names, entries, strict=True)]
            out.append(Trial(case["fabric"], *(np.array(column) for column in zip(*pairs, strict=True))))
    return out


def _to_normal_coordinates(name: str, value: float, std: float) -> tuple[float, float]:
    """Return the logarithm, or the logit of twice Poisson's ratio, and its standard deviation."""
    if name == "poisson_ratio":
        return float(np.log(value / (0.5 - value))), std * 0.5 / (value * (0.5 - value))
    return float(np.log(value)), std / value


def confusion_matrix(trials: Sequence[Trial], fabrics: Sequence[str]) -> dict[str, Any]:
    """Assign each trial with the others of its fabric as reference.

    Returns:
        ``matrix``: true fabric -> assigned fabric -> count. ``trials``: number of trials of fabrics with enough others;
        ``right``: number of correct ones. ``within``: number within the 95 % distance of their fabric. ``margin``:
        smallest distance from a wrong fabric in standard deviations. ``distance``: true fabric -> fabric -> mean.
    """
    matrix = {a: dict.fromkeys(fabrics, 0) for a in fabrics}
    distances: dict[str, dict[str, list[float]]] = {a: {b: [] for b in fabrics} for a in fabrics}
    within = judged = 0
    for i, trial in enumerate(trials):
        others = [t for j, t in enumerate(trials) if j != i]
        squared = {name: _squared_distance(trial, [t for t in others if t.fabric == name]) for name in fabrics}
        known = {name: d for name, d in squared.items() if d is not None}
        if trial.fabric not in known:  # its fabric has too few other trials: the answer could only be wrong
            continue
        judged += 1
        matrix[trial.fabric][min(known, key=lambda name: known[name])] += 1
        within += known[trial.fabric] <= CHI2_95[len(trial.place)]
        for name, d in known.items():
            distances[trial.fabric][name].append(d**0.5)
    wrong = [d for a, row in distances.items() for b, entries in row.items() if a != b for d in entries]
    return {
        "trials": judged,
        "right": sum(matrix[name][name] for name in fabrics),
        "within": int(within),
        "margin": min(wrong) if wrong else None,
        "matrix": matrix,
        "distance": {a: {b: float(np.mean(d)) if d else None for b, d in row.items()} for a, row in distances.items()},
    }


def _squared_distance(trial: Trial, others: Sequence[Trial]) -> float | None:
    """Return the squared Mahalanobis distance of a trial from a fabric's others; None if these are too few."""
    if len(others) < MIN_OTHER_TRIALS:
        return None
    places, errors = np.stack([t.place for t in others]), np.stack([t.error for t in others])
    spread = np.atleast_2d(np.cov(places.T, ddof=1))
    trial_cov, others_cov = np.diag(trial.error**2), np.diag((errors**2).mean(0))
    excess = _nearest_covariance(spread - others_cov)
    deviation = trial.place - places.mean(0)
    return float(deviation @ np.linalg.solve(trial_cov + excess + (others_cov + excess) / len(others), deviation))


def _nearest_covariance(matrix: np.ndarray) -> np.ndarray:
    """Return the nearest covariance, with negative eigenvalues set to zero."""
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * values.clip(min=0)) @ vectors.T


def _show(results: Mapping[str, Mapping[str, Any]]) -> None:
    from rich.console import Console

    console = Console(highlight=False)
    console.width = max(console.width, 118)
    for title, result in results.items():
        headings = [FABRICS[name] for name in result["matrix"]]
        out = make_table(f"From {title}: each trial left out, and assigned to", "is in truth", *headings, left=1)
        for name, row in result["matrix"].items():
            distances_text = result["distance"][name]
            out.add_row(FABRICS[name], *(_cell(row[other], distances_text[other]) for other in row))
        console.print(out)
        n, margin = result["trials"], result["margin"]
        distances_text = "–" if margin is None else f"{margin:.1f}"
        console.print(
            f"{result['right']} of {n} right; nearest wrong fabric {distances_text} standard deviations away; "
            f"{result['within']} of {n} as near their own as 95 % should be. In brackets: mean distance.\n",
            markup=False,
        )
    console.print(f'The paper says that "{CLAIM}" and gives no table of it.', markup=False)


def _cell(count: int, distance: float | None) -> str:
    return f"{count or '·'}" + ("" if distance is None else f" ({distance:.1f})")
