"""The cases are a package beside the other tests; ``run.py`` finds it by itself."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
