"""Constitutive laws, one per file."""

from .aep import AEP
from .base import AbstractMaterial, Stiffness

__all__ = ["AEP", "AbstractMaterial", "Stiffness"]
