"""Coverage of the intervals of archived answers, as they are and with a share of the number in quadrature.

python -m torchcloth.training.validation.hidden.interval_coverage docs/hidden/rounds/*.xz     # archives, or folders of `studies hidden`
"""

from __future__ import annotations

import argparse
import math
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from torchcloth.errors import InvalidInput
from torchcloth.training.studies import hidden_scores as scores
from torchcloth.training.studies.hidden_archive import read_round

from .effect_map import NUMBERS

SHARES = (0.0, 0.02, 0.03, 0.04)  # of the number, standard deviations
THICK = 1e-3  # m, of all sheets
NORMAL = 1.96


def apart(answer: dict[str, Any], ends: Sequence[float], number: float) -> float:
    """The standard error without the share that answers have had since they have one."""
    low, high = ends
    return max(((high - low) / (2 * NORMAL)) ** 2 - (answer.get("common_error", 0.0) * number) ** 2, 0.0) ** 0.5


def amplitudes(truth: dict[str, Any], answer: dict[str, Any]) -> Iterator[tuple[str, float, float]]:
    """("amplitude", error, standard error) of each that is named outright, over what is hidden."""
    asked = scores.wanted(truth)
    for cause, wanted in zip(scores._matched(scores.named(answer), asked), asked, strict=True):
        if cause is not None and cause.best in wanted.names and wanted.comparable:
            std = apart(answer, cause.ci95, cause.amplitude) / abs(wanted.amplitude)
            yield "amplitudes", cause.amplitude / wanted.amplitude - 1, std


def numbers(truth: dict[str, Any], answer: dict[str, Any]) -> Iterator[tuple[str, float, float]]:
    """(name, error of the logarithm, standard error) of the fabric's numbers, of a null."""
    if truth["family"] not in scores.NULLS:
        return
    for name, own in NUMBERS.items():
        if (row := answer.get("parameters", {}).get(name)) is not None:
            true = truth["fabric"][own] / (THICK if name == "youngs_modulus" else 1.0)
            ends = [math.log(end) for end in row["ci95"]]
            yield f"{name} of nulls", math.log(row["value"] / true), apart(answer, ends, 1.0)


def main(arguments: list[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rounds", nargs="+", type=Path, metavar="ROUND")
    rows: dict[str, list[tuple[float, float]]] = defaultdict(list)
    try:
        cases = [case for path in parser.parse_args(arguments).rounds for case in read_round(path).cases.values()]
    except InvalidInput as error:
        print(error, file=sys.stderr)
        return 2
    for case in cases:
        for errors_of in (amplitudes, numbers):
            for name, error, std in errors_of(case["truth"], case["answer"]):
                rows[name].append((error, std))
    if not rows:
        print("these rounds have no answer that can be compared", file=sys.stderr)
        return 2
    print("| of | number | mean error |" + "".join(f" held, with {100 * s:.0f} % |" for s in SHARES))
    print("| --- |" + " --- |" * (2 + len(SHARES)))
    for name, each in rows.items():
        held = [sum(abs(e) < NORMAL * math.hypot(s, share) for e, s in each) / len(each) for share in SHARES]
        mean = sum(e for e, _ in each) / len(each)
        print(f"| {name} | {len(each)} | {100 * mean:+.1f} % |" + "".join(f" {100 * h:.0f} % |" for h in held))
    return 0


if __name__ == "__main__":
    sys.exit(main())
