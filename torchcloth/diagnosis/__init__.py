"""What a simulation gets wrong, why, and what mending it gains.

``diagnose`` runs all stages; each can be called alone: ``check``, ``base_model``, ``setting_of``, ``approach``,
``gather``, ``fit_noise``, ``fit``, ``unstable``, ``screen``, ``correlations``, ``predict``, ``compare``, ``placebo``,
``search``, ``doubted``, ``judge``, ``lack_of_fit``, ``drifts``, ``missing_force``, ``learn_residual``, ``propose``.
Read ``stepwise.py`` and ``trials.py`` first.
"""

from .approaching import approach
from .base_model import base_model
from .branches import unstable
from .classes import correlations
from .comparison import Gain, compare, predict
from .confirming import Confirmation, confirm
from .drifting import drifts
from .evidence import gather
from .fitting import Fitted, fit
from .gate import Fault, check, read_episodes
from .hypotheses import catalogue, register
from .lacking import lack_of_fit
from .loading import (
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
from .missing import MissingForce, missing_force
from .model_file import load_model, read_model, save_model
from .next_experiment import propose
from .noise import fit_noise
from .own_causes import register_file
from .placebos import placebo
from .residual import Residual, doubted, learn_residual
from .run import diagnose, write_diagnosis
from .screening import screen
from .setting import setting_of
from .stepwise import search
from .verdict import Diagnosis, judge, refused
from .world import Hypothesis, Model, World

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
