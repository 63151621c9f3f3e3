"""Train a pose network: ``python -m torchcloth.training.pose --out DIR``; see ``docs/explanation/pose.md``."""

import sys

from .command import main

sys.exit(main())
