"""Physical effects on the bare membrane, one per file. Their forces add, so their order does not matter."""

from .added_mass import AddedMass
from .adhesion import Adhesion
from .air import AirDrag
from .base import AbstractEffect, Amplitude
from .bending import Bending
from .body_force import BodyForce
from .crease import CreasingBending
from .damping import MassDamping
from .friction import BendingFriction, ShearFriction
from .gravity import Gravity
from .grip_slip import GripSlip
from .hem import LineMass
from .residual import ResidualForce
from .rest_shape import RestShape
from .saturating import SaturatingBending
from .viscous import KelvinVoigt

__all__ = [
    "AbstractEffect",
    "AddedMass",
    "Adhesion",
    "AirDrag",
    "Amplitude",
    "Bending",
    "BendingFriction",
    "BodyForce",
    "CreasingBending",
    "Gravity",
    "GripSlip",
    "KelvinVoigt",
    "LineMass",
    "MassDamping",
    "ResidualForce",
    "RestShape",
    "SaturatingBending",
    "ShearFriction",
]
