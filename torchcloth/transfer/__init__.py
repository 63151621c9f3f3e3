"""Particle-grid transfer: how contact passes between layers of cloth."""

from .contact import SKIN, TURNED, Contact, Grid
from .neighbours import apart
from .reference import Stencil, push, stencil, velocity_gradient

__all__ = ["SKIN", "TURNED", "Contact", "Grid", "Stencil", "apart", "push", "stencil", "velocity_gradient"]
