"""Particle-grid transfer: how contact passes between layers of cloth."""

from .grid import FADING, GAP, RANGE, SKIN, TOUCH, TURNED, Contact, Grid
from .transfer import Stencil, carried_momentum, lattice, push, stencil, through, velocity_gradient

__all__ = [
    "FADING",
    "GAP",
    "RANGE",
    "SKIN",
    "TOUCH",
    "TURNED",
    "Contact",
    "Grid",
    "Stencil",
    "carried_momentum",
    "lattice",
    "push",
    "stencil",
    "through",
    "velocity_gradient",
]
