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
from .data.data_checks import Fault, check, read_episodes
from .data.dataset import setting_of
from .decide.search import search
from .decide.verdict import Diagnosis, judge, refused
from .experiment.proposal import propose
from .inference.bifurcations import unstable
from .inference.comparison import Gain, compare, predict
from .inference.confounding import correlations
from .inference.fitting import Fitted, fit
from .inference.force_drift import drifts
from .inference.lack_of_fit import lack_of_fit
from .inference.linearise import gather
from .inference.noise import fit_noise
from .inference.permutation_test import placebo
from .inference.screening import screen
from .inference.warm_start import approach
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
from .unknown.residual_force import Residual, doubted, learn_residual

__all__ = [
    "Confirmation",
    "Diagnosis",
    "Fault",
    "Fitted",
    "Gain",
    "Hypothesis",
    "MissingForce",
    "Model",
    "Residual",
    "World",
    "approach",
    "base_model",
    "begin_with",
    "beside_the_cloth",
    "catalogue",
    "check",
    "cloth_for",
    "compare",
    "confirm",
    "correlations",
    "diagnose",
    "doubted",
    "drawn_models",
    "drifts",
    "fit",
    "fit_noise",
    "gather",
    "judge",
    "lack_of_fit",
    "learn_residual",
    "load",
    "load_model",
    "load_world",
    "missing_force",
    "placebo",
    "predict",
    "predicted",
    "propose",
    "read_episodes",
    "read_model",
    "refused",
    "register",
    "register_file",
    "save_model",
    "screen",
    "search",
    "setting_of",
    "start_of",
    "uncertain",
    "unstable",
    "was_fitted",
    "write_diagnosis",
]
