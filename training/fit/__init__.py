"""Gradient fits as Lightning runs: ``python -m torchcloth.training.fit --config FILE``.

See docs/how-to/train-with-lightning.md.

Scalars, fields with one value per triangle, or a network that gives them, are learned from many episodes. A run may
use as many processes as there are episodes in a step.
"""
