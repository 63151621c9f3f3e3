"""Command line of programs that print something about one case as JSON."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable

from .case_sampling import FAST_SIZE, ROUND_SIZE, Case, draw_case


def print_case_json(
    description: str | None, compute: Callable[[Case], object], arguments: list[str] | None = None
) -> int:
    """Print the JSON of ``compute(case)`` for the case that the arguments name; return the exit code."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--fast", action="store_true", help="if the case was made with --fast")
    options = parser.parse_args(arguments)
    try:
        print(json.dumps(compute(draw_case(options.seed, FAST_SIZE if options.fast else ROUND_SIZE)), indent=1))
    except ValueError as error:
        print(error, file=sys.stderr)
        return 2
    return 0
