"""Run the tests of every trial, print what they show: ``python -m torchcloth.training.validation.trials [--out FILE]``.

Call it at the root of the repository; it takes some minutes. With ``--out docs/validation/trials.md`` it also writes
that page of the documentation. Exit code: 0 no test failed, 1 a test failed or is missing, 2 wrong input.
"""

import sys

from .command import main

sys.exit(main())
