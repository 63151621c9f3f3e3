"""``python -m torchcloth.training.fit``."""

import sys

from .command import main

sys.exit(main())
