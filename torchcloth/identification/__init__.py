"""From recordings to fabric parameters with error bars."""

from .episodes import Episode, cloth_from, episode
from .fit import identify
from .null import rigid_carry
from .pictures import draw
from .result import Identification
from .statements import Estimate
from .tables import print_fit

__all__ = [
    "Episode",
    "Estimate",
    "Identification",
    "cloth_from",
    "draw",
    "episode",
    "identify",
    "print_fit",
    "rigid_carry",
]
