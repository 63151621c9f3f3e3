"""``python -m torchcloth.training.validation.trials``."""

import sys

from .command import main

sys.exit(main())
