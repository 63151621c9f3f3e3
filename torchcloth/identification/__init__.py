"""From recordings to fabric parameters with error bars."""

from .draws import drawn
from .episode_prediction import EpisodePrediction, predict_episode
from .episodes import Episode, cloth_from, episode
from .fields import FieldFit, fit_fields
from .fit import identify
from .null import rigid_carry
from .pictures import draw
from .result import Identification
from .saved import Replayed, fitted, is_fitted, replayed
from .specimens import AbstractSpecimen, Response, Trellis, Uniaxial
from .statements import Estimate
from .tables import print_fit, print_tension
from .tension import TensionFit, fit_tension
from .tension_model import TensionModel, read_model
from .tension_prediction import Band, TensionPrediction, cross_validated, predict_tension, specimen_like

__all__ = [
    "AbstractSpecimen",
    "Band",
    "Episode",
    "EpisodePrediction",
    "Estimate",
    "FieldFit",
    "Identification",
    "Replayed",
    "Response",
    "TensionFit",
    "TensionModel",
    "TensionPrediction",
    "Trellis",
    "Uniaxial",
    "cloth_from",
    "cross_validated",
    "draw",
    "drawn",
    "episode",
    "fit_fields",
    "fit_tension",
    "fitted",
    "identify",
    "is_fitted",
    "predict_episode",
    "predict_tension",
    "print_fit",
    "print_tension",
    "read_model",
    "replayed",
    "rigid_carry",
    "specimen_like",
]
