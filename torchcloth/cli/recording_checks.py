"""The option of verbs that check a recording before they use it."""

from __future__ import annotations

import argparse


def add_checks_option(parser: argparse.ArgumentParser) -> None:
    """Add ``--checks`` and ``--no-checks``."""
    parser.add_argument(
        "--checks",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="leave out frozen clouds, and correct a clock that is off (default: yes)",
    )
