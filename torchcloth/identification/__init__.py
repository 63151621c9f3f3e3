"""From recordings to fabric parameters with error bars."""

from .episodes import Episode, cloth_from, episode
from .fit import identify
from .result import Estimate, Identification

__all__ = ["Episode", "Estimate", "Identification", "cloth_from", "episode", "identify"]
