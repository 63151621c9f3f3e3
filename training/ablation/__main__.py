"""Repeat the paper's ablation and energy experiments: ``python -m torchcloth.training.ablation --out DIR``.

See ``command`` for what is simulated and compared.
"""

import sys

from .command import main

sys.exit(main())
