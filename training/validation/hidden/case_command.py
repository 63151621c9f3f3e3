"""Command lines that say something of one case, as JSON."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable

from .case_sampling import REDUCED, SMALL, Case, case


def told(about: str | None, of: Callable[[Case], object], arguments: list[str] | None = None) -> int:
    """Print what ``of`` says of the case that is asked for; returns the exit code."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--fast", action="store_true", help="as the case was made")
    options = parser.parse_args(arguments)
    try:
        print(json.dumps(of(case(options.seed, SMALL if options.fast else REDUCED)), indent=1))
    except ValueError as error:
        print(error, file=sys.stderr)
        return 2
    return 0
