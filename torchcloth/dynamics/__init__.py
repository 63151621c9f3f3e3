"""The physics of one substep: kinematics, elasticity, forces, viscous stages, contact between layers, stability.

Start with ``substep``: it is the whole algorithm on one page, in order.
"""

from .kinematics import Geometry, surface
from .model import Model
from .substep import energy, rollout, step

__all__ = ["Geometry", "Model", "energy", "rollout", "step", "surface"]
