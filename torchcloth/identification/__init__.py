"""From recordings to fabric parameters with error bars."""

from .episodes import Episode, cloth_from, episode
from .fields import FieldFit, fit_fields
from .fit import identify
from .null import rigid_carry
from .pictures import draw
from .result import Identification
from .saved import Replayed, fitted, replayed
from .specimens import AbstractSpecimen, Response, Trellis, Uniaxial
from .statements import Estimate
from .tables import print_fit, print_tension
from .tension import TensionFit, fit_tension

__all__ = [
    "AbstractSpecimen",
    "Episode",
    "Estimate",
    "FieldFit",
    "Identification",
    "Replayed",
    "Response",
    "TensionFit",
    "Trellis",
    "Uniaxial",
    "cloth_from",
    "draw",
    "episode",
    "fit_fields",
    "fit_tension",
    "fitted",
    "identify",
    "print_fit",
    "print_tension",
    "replayed",
    "rigid_carry",
]
