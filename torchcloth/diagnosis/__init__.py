"""What a simulation gets wrong, why, and what mending it gains.

``diagnose`` runs all stages; each can be called alone: ``base_model``, ``setting_of``, ``gather``, ``fit_noise``,
``fit``, ``screen``, ``predict``, ``compare``, ``search``, ``judge``. Read ``stepwise.py`` first.
"""

from .base_model import base_model
from .comparison import Gain, compare, predict
from .evidence import gather, setting_of
from .fitting import Fitted, fit
from .gate import Fault, check, read_episodes
from .hypotheses import catalogue, register
from .lacking import lack_of_fit
from .missing import MissingForce, missing_force
from .model_file import load_model, save_model
from .noise import fit_noise
from .residual import Residual, learn_residual
from .run import diagnose, write_diagnosis
from .screening import screen
from .stepwise import search
from .verdict import Diagnosis, judge, refused
from .world import Hypothesis, Model, World

__all__ = [
    "Diagnosis",
    "Fault",
    "Fitted",
    "Gain",
    "Hypothesis",
    "MissingForce",
    "Model",
    "Residual",
    "World",
    "base_model",
    "catalogue",
    "check",
    "compare",
    "diagnose",
    "fit",
    "fit_noise",
    "gather",
    "judge",
    "lack_of_fit",
    "learn_residual",
    "load_model",
    "missing_force",
    "predict",
    "read_episodes",
    "refused",
    "register",
    "save_model",
    "screen",
    "search",
    "setting_of",
    "write_diagnosis",
]
