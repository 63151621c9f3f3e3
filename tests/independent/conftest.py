"""The modules of this folder are scripts beside each other: make them importable by name, as `python
make_example.py` does.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
