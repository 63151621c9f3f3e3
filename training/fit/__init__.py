"""Gradient fits as Lightning runs: ``python -m torchcloth.training.fit --config FILE``; see docs/how-to/train-with-lightning.md.

Scalars, fields per triangle, or a network that feeds them, learned from many episodes, on as many processes as there
are episodes at a step.
"""
