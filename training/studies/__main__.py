"""Run ``python -m torchcloth.training.studies``."""

import sys

from .command import main

sys.exit(main())
