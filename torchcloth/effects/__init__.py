"""Physical effects on the bare membrane, one per file, keyed by name. They add, so their order cannot matter."""

from .air import AirDrag
from .base import AbstractEffect, Amplitude
from .bending import Bending
from .damping import MassDamping
from .gravity import Gravity

__all__ = ["AbstractEffect", "AirDrag", "Amplitude", "Bending", "Gravity", "MassDamping"]
