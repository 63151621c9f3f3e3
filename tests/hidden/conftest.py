"""Modules beside the tests, and those of the other engine."""

import sys
from pathlib import Path

if (here := str(Path(__file__).parent)) not in sys.path:
    sys.path.append(here)

import beside  # noqa: F401
