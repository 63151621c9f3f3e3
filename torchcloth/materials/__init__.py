"""Constitutive laws of the sheet, one per file, and published fabrics."""

from . import presets
from .aep import AEP
from .base import AbstractMaterial, Stiffness
from .director import DirectorMaterial
from .orthotropic import OrthotropicAEP, StiffeningAEP
from .yielding import NormYield

__all__ = [
    "AEP",
    "AbstractMaterial",
    "DirectorMaterial",
    "NormYield",
    "OrthotropicAEP",
    "StiffeningAEP",
    "Stiffness",
    "presets",
]
