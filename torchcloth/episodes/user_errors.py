"""What a user's own cause does wrong, said by the place in the user's file."""

from __future__ import annotations

import traceback
from pathlib import Path

from ..errors import InvalidInput

LIBRARY = Path(__file__).parents[1]
GIVES = "apply(world, amplitude) that gives a world, whose motions give episodes and views frames"


def blame(name: str, error: Exception) -> InvalidInput:
    """For an error that is none of the library's, of the hypothesis of this name."""
    places = [p for p in traceback.extract_tb(error.__traceback__) if not Path(p.filename).is_relative_to(LIBRARY)]
    own = [p for p in places if "site-packages" not in p.filename]
    where = f" in {own[-1].filename}, line {own[-1].lineno}" if own else ""
    return InvalidInput(f"hypothesis {name!r}", got=f"{type(error).__name__}: {error}{where}", expected=GIVES)
