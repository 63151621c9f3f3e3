"""From recordings to fabric parameters with error bars."""

from ..episodes.observed import Episode, cloth_from, episode
from .episode_prediction import EpisodePrediction, predict_episode
from .fields import FieldFit, fit_fields
from .fit import identify
from .io.saved_fit import Replayed, fitted, is_fitted, replayed
from .pictures import draw
from .residuals.rigid_carry import rigid_carry
from .result import Identification
from .tables import print_fit, print_tension
from .tension.fit import TensionFit, fit_tension
from .tension.model import TensionModel, read_model
from .tension.prediction import Band, TensionPrediction, cross_validated, predict_tension, specimen_like
from .tension.specimens import AbstractSpecimen, Response, Trellis, Uniaxial
from .uncertainty.estimates import Estimate
from .uncertainty.posterior_samples import drawn

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
