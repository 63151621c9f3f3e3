"""Run a study that the documentation cites: ``python -m torchcloth.training.studies NAME --out DIR [--fast]``.

``--help`` lists the studies.
"""

import sys

from .command import main

sys.exit(main())
