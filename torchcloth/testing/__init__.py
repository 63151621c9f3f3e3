"""Contracts for your own parts: inherit one, define how to make the part, and pytest checks what the layer relies on.

    class TestMyFabric(torchcloth.testing.MaterialContract):
        def make(self):
            return MyFabric(stiffness=300.0)

pytest is optional: ``MyContract().check()`` checks the same promises anywhere.
"""

from .boundary import BoundaryContract, GraspContract
from .collider import ColliderContract
from .contract import Contract
from .effect import EffectContract
from .finite_differences import Sweep, check_gradients, finite_difference_sweep
from .material import MaterialContract

__all__ = [
    "BoundaryContract",
    "ColliderContract",
    "Contract",
    "EffectContract",
    "GraspContract",
    "MaterialContract",
    "Sweep",
    "check_gradients",
    "finite_difference_sweep",
]
