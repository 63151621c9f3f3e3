"""Particle-grid transfer: how contact passes between layers of cloth."""

from .contact import FADING, GAP, RANGE, SKIN, TOUCH, TURNED, Contact, Grid
from .reference import Stencil, carried_momentum, lattice, push, stencil, through, velocity_gradient

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
