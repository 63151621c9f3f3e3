"""What a simulation gets wrong, why, and what mending it gains.

``diagnose`` runs all stages; each can be called alone: ``check``, ``base_model``, ``setting_of``, ``approach``,
``gather``, ``fit_noise``, ``fit``, ``unstable``, ``screen``, ``correlations``, ``predict``, ``compare``, ``placebo``,
``search``, ``doubted``, ``judge``, ``lack_of_fit``, ``drifts``, ``missing_force``, ``learn_residual``, ``propose``.
Read ``stepwise.py`` and ``trials.py`` first.
"""

from ..episodes.world import Hypothesis, Model, World
from .causes.hypotheses import catalogue, register
from .causes.user_hypotheses import register_file
from .confirmation import Confirmation, confirm
from .data.data_checks import Fault, check_episodes, read_episodes
from .data.dataset import prepare_data
from .decide.search import search
from .decide.verdict import Diagnosis, judge, refuse
from .experiment.proposal import propose
from .inference.bifurcations import find_bifurcating_bins
from .inference.comparison import Gain, compare, predict_held_out
from .inference.confounding import correlate_scores
from .inference.fitting import ModelFit, fit
from .inference.force_drift import estimate_force_drifts
from .inference.lack_of_fit import measure_lack_of_fit
from .inference.linearise import linearise
from .inference.noise import fit_noise
from .inference.permutation_test import run_permutation_test
from .inference.screening import screen
from .inference.warm_start import quadratic_warm_start
from .models.base_model import base_model
from .models.loading import (
    begin_with,
    beside_the_cloth,
    cloth_for,
    drawn_models,
    load,
    load_world,
    predicted,
    start_of,
    uncertain,
    was_fitted,
)
from .models.model_file import load_model, read_model, save_model
from .run import diagnose, write_diagnosis
from .unknown.missing_force import MissingForce, missing_force
from .unknown.residual_force import ResidualForceFit, check_against_laws, learn_residual_force

__all__ = [
    "Confirmation",
    "Diagnosis",
    "Fault",
    "ModelFit",
    "Gain",
    "Hypothesis",
    "MissingForce",
    "Model",
    "ResidualForceFit",
    "World",
    "quadratic_warm_start",
    "base_model",
    "begin_with",
    "beside_the_cloth",
    "catalogue",
    "check_episodes",
    "cloth_for",
    "compare",
    "confirm",
    "correlate_scores",
    "diagnose",
    "check_against_laws",
    "drawn_models",
    "estimate_force_drifts",
    "fit",
    "fit_noise",
    "linearise",
    "judge",
    "measure_lack_of_fit",
    "learn_residual_force",
    "load",
    "load_model",
    "load_world",
    "missing_force",
    "run_permutation_test",
    "predict_held_out",
    "predicted",
    "propose",
    "read_episodes",
    "read_model",
    "refuse",
    "register",
    "register_file",
    "save_model",
    "screen",
    "search",
    "prepare_data",
    "start_of",
    "uncertain",
    "find_bifurcating_bins",
    "was_fitted",
    "write_diagnosis",
]
