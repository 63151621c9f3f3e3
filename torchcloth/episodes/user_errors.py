"""Explain errors in a user's own hypothesis by their place in the user's file."""

from __future__ import annotations

import traceback
from pathlib import Path

from ..errors import InvalidInput

LIBRARY_FOLDER = Path(__file__).parents[1]
EXPECTED_APPLY = (
    "apply(world, amplitude) that gives a world, whose motion transforms give episodes and whose observation "
    "transforms give frames"
)


def explain_user_error(name: str, error: Exception) -> InvalidInput:
    """Return an error of the library for a foreign one that the hypothesis of this name caused."""
    frames = traceback.extract_tb(error.__traceback__)
    foreign = [f for f in frames if not Path(f.filename).is_relative_to(LIBRARY_FOLDER)]
    of_user = [f for f in foreign if "site-packages" not in f.filename]
    place = f" in {of_user[-1].filename}, line {of_user[-1].lineno}" if of_user else ""
    return InvalidInput(f"hypothesis {name!r}", got=f"{type(error).__name__}: {error}{place}", expected=EXPECTED_APPLY)
