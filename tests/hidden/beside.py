"""Makes the other engine's modules importable."""

import sys
from pathlib import Path

if (folder := str(Path(__file__).parents[1] / "independent")) not in sys.path:
    sys.path.append(folder)
