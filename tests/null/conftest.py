"""The modules of this folder are a package beside the other tests, as ``run.py`` has them."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
