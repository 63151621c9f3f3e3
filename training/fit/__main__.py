"""Fit a cloth to data with Lightning: ``python -m torchcloth.training.fit --config FILE [KEY=VALUE ...]``.

``--config demo`` runs the demonstration, ``--resume`` goes on with a run that was stopped. See
``docs/how-to/train-with-lightning.md``.
"""

import sys

from .command import main

sys.exit(main())
