"""From recordings to fabric parameters with error bars."""

from ..episodes.observed import Episode, build_episode
from ..episodes.recorded_cloth import build_cloth
from .episode_prediction import EpisodePrediction, predict_episode
from .fields import FieldFit, fit_fields
from .fit import identify
from .io.saved_fit import ReplayedEpisode, is_fitted_episode, load_fitted_cloth, replay_fit
from .pictures import save_fit_pictures
from .residuals.rigid_carry import carry_rigidly
from .result import Identification
from .tables import print_fit, print_tension
from .tension.fit import TensionFit, fit_tension
from .tension.model import TensionModel, read_tension_model
from .tension.prediction import PredictionBand, TensionPrediction, cross_validate, make_specimen, predict_tension
from .tension.specimens import AbstractSpecimen, Response, Trellis, Uniaxial
from .uncertainty.estimates import Estimate
from .uncertainty.posterior_samples import sample_posterior
from .verdict import describe_verdict

__all__ = [
    "AbstractSpecimen",
    "Episode",
    "EpisodePrediction",
    "Estimate",
    "FieldFit",
    "Identification",
    "PredictionBand",
    "ReplayedEpisode",
    "Response",
    "TensionFit",
    "TensionModel",
    "TensionPrediction",
    "Trellis",
    "Uniaxial",
    "build_cloth",
    "build_episode",
    "carry_rigidly",
    "cross_validate",
    "describe_verdict",
    "fit_fields",
    "fit_tension",
    "identify",
    "is_fitted_episode",
    "load_fitted_cloth",
    "make_specimen",
    "predict_episode",
    "predict_tension",
    "print_fit",
    "print_tension",
    "read_tension_model",
    "replay_fit",
    "sample_posterior",
    "save_fit_pictures",
]
