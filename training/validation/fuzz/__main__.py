"""Search for inputs that break a reader of files: ``python -m torchcloth.training.validation.fuzz FORMAT``.

Call it at the root of the repository, where the seeds lie. The search ends after ``--inputs N`` (default a million) or
``--seconds S``. An input breaks a reader if anything but a ``TorchclothError`` is raised, or if what is accepted breaks
the promises of its format. Such inputs are written into ``CORPUS/faults``. Exit code: 0 no faults, 1 faults, 2 wrong
input.
"""

import sys

from .command import main

sys.exit(main())
