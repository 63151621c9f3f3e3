"""Print how often the intervals of archived answers contain the truth, with and without a common error.

    python -m torchcloth.training.validation.hidden.interval_coverage docs/validation/blind-rounds/answers/*.xz

A common error is a fraction of each value that is added to its standard error in quadrature. Arguments are archives, or
folders of ``studies hidden``.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from torchcloth._utils.constants import Z_95
from torchcloth.errors import InvalidInput

from ...studies import hidden_scores as scores
from ...studies.hidden_archive import read_round
from .effect_map import FITTED_FABRIC_VALUES

COMMON_ERROR_FRACTIONS = (0.0, 0.02, 0.03, 0.04)  # of the value, standard deviations
SHEET_THICKNESS_M = 1e-3  # of all sheets


def std_without_common_error(answer: dict[str, Any], ends: Sequence[float], value: float) -> float:
    """Return the standard error of an interval, less the common error that newer answers include."""
    low, high = ends
    variance = ((high - low) / (2 * Z_95)) ** 2 - (answer.get("common_relative_error", 0.0) * value) ** 2
    return max(variance, 0.0) ** 0.5


def amplitude_errors(truth: dict[str, Any], answer: dict[str, Any]) -> Iterator[tuple[str, float, float]]:
    """Yield ("amplitudes", relative error, its standard error) of each effect that is named outright."""
    expected = scores.list_expected_effects(truth)
    for cause, effect in zip(scores.match_causes(scores.list_named_causes(answer), expected), expected, strict=True):
        if cause is not None and cause.name in effect.names and effect.comparable:
            std = std_without_common_error(answer, cause.ci95, cause.amplitude) / abs(effect.amplitude)
            yield "amplitudes", cause.amplitude / effect.amplitude - 1, std


def fabric_errors(truth: dict[str, Any], answer: dict[str, Any]) -> Iterator[tuple[str, float, float]]:
    """Yield (name, error of the logarithm, its standard error) of the fabric's fitted values in null cases."""
    if truth["family"] not in scores.NULL_FAMILIES:
        return
    for name, fabric_name in FITTED_FABRIC_VALUES.items():
        if (row := answer.get("parameters", {}).get(name)) is not None:
            true_value = truth["fabric"][fabric_name] / (SHEET_THICKNESS_M if name == "youngs_modulus" else 1.0)
            log_ends = [math.log(end) for end in row["ci95"]]
            yield (
                f"{name} of nulls",
                math.log(row["value"] / true_value),
                std_without_common_error(answer, log_ends, 1.0),
            )


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rounds", nargs="+", type=Path, metavar="ROUND")
    rows: dict[str, list[tuple[float, float]]] = defaultdict(list)
    try:
        cases = [case for path in parser.parse_args(arguments).rounds for case in read_round(path).cases.values()]
    except InvalidInput as error:
        print(error, file=sys.stderr)
        return 2
    for case in cases:
        for errors_of in (amplitude_errors, fabric_errors):
            for name, error, std in errors_of(case["truth"], case["answer"]):
                rows[name].append((error, std))
    if not rows:
        print("these rounds have no answer that can be compared", file=sys.stderr)
        return 2
    headings = "".join(f" covered, common error {100 * f:.0f} % |" for f in COMMON_ERROR_FRACTIONS)
    print("| value | number | mean error |" + headings)
    print("| --- |" + " --- |" * (2 + len(COMMON_ERROR_FRACTIONS)))
    for name, pairs in rows.items():
        covered = [
            sum(abs(e) < Z_95 * math.hypot(s, fraction) for e, s in pairs) / len(pairs)
            for fraction in COMMON_ERROR_FRACTIONS
        ]
        mean = sum(e for e, _ in pairs) / len(pairs)
        print(f"| {name} | {len(pairs)} | {100 * mean:+.1f} % |" + "".join(f" {100 * c:.0f} % |" for c in covered))
    return 0


if __name__ == "__main__":
    sys.exit(main())
