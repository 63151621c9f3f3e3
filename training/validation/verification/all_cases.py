"""Import all cases, in the order of the table."""

from . import gradients, symmetry, elasticity, bending, dynamics, contact, folding, plasticity, convergence  # noqa: F401, I001
