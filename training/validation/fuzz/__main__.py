"""``python -m torchcloth.training.validation.fuzz``."""

import sys

from .command import main

sys.exit(main())
