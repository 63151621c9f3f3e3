"""``python -m torchcloth.training.ablation``."""

import sys

from .command import main

sys.exit(main())
