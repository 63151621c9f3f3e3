"""What a simulation gets wrong, why, and what correcting it gains.

``diagnose`` runs all stages in this order; each can be called alone:

1. ``check_episodes``, ``build_base_model``, ``list_hypotheses``, ``prepare_data``: data, model and hypotheses.
2. ``search``: ``quadratic_warm_start``, ``fit`` (``linearise``, ``fit_noise``), ``find_bifurcating_bins``, ``screen``,
   ``predict_held_out``, ``compare``, ``run_permutation_test``. ``decide/criteria.py`` lists all thresholds and the
   gates that apply them.
3. ``check_against_laws``, ``measure_lack_of_fit``, ``estimate_force_drifts``, ``estimate_missing_force``,
   ``learn_residual_force``: what no known cause explains.
4. ``judge``, ``propose_experiment``, ``write_diagnosis``: verdict, next experiment and files.

``confirm`` measures the gain on new episodes.
"""

from ..episodes.world import Hypothesis, World, WorldModel
from .causes.hypotheses import list_hypotheses, register
from .causes.user_hypotheses import register_file
from .confirmation import Confirmation, confirm
from .data.data_checks import Fault, check_episodes, read_episodes
from .data.dataset import prepare_data
from .decide.criteria import CRITERIA, Criteria
from .decide.search import search
from .decide.verdict import Diagnosis, judge, refuse
from .experiment.proposal import propose_experiment
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
from .models.base_model import build_base_model
from .models.loading import (
    derive_priors,
    draw_models,
    list_causes_outside_cloth,
    load,
    load_cloth_for,
    load_world,
    make_start_builder,
    predict_episode,
    start_from_model,
    was_fitted,
)
from .models.model_file import load_model, read_model, save_model
from .run import diagnose, write_diagnosis
from .unknown.missing_force import MissingForce, estimate_missing_force
from .unknown.residual_force import ResidualForceFit, check_against_laws, learn_residual_force

__all__ = [
    "CRITERIA",
    "Confirmation",
    "Criteria",
    "Diagnosis",
    "Fault",
    "Gain",
    "Hypothesis",
    "MissingForce",
    "ModelFit",
    "ResidualForceFit",
    "World",
    "WorldModel",
    "build_base_model",
    "check_against_laws",
    "check_episodes",
    "compare",
    "confirm",
    "correlate_scores",
    "derive_priors",
    "diagnose",
    "draw_models",
    "estimate_force_drifts",
    "estimate_missing_force",
    "find_bifurcating_bins",
    "fit",
    "fit_noise",
    "judge",
    "learn_residual_force",
    "linearise",
    "list_causes_outside_cloth",
    "list_hypotheses",
    "load",
    "load_cloth_for",
    "load_model",
    "load_world",
    "make_start_builder",
    "measure_lack_of_fit",
    "predict_episode",
    "predict_held_out",
    "prepare_data",
    "propose_experiment",
    "quadratic_warm_start",
    "read_episodes",
    "read_model",
    "refuse",
    "register",
    "register_file",
    "run_permutation_test",
    "save_model",
    "screen",
    "search",
    "start_from_model",
    "was_fitted",
    "write_diagnosis",
]
