"""Cloths sampled from the posterior distribution of a fit."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch

from ...cloth import Cloth
from ...episodes.unknowns import LOG_DECADE, find_scalar_parameters
from ...parameters import PhysicalParameter, to_physical
from ...recordings import Recording
from ..io.saved_fit import ClothBuilder, read_saved_fit, rebuild_fitted_cloth

MAX_SAMPLE_STD_ERRORS = 3.0  # beyond which nothing is sampled
UNTRANSFORMED_DOMAINS = ("nonnegative", "real")  # of parameters that are stored as they are


def sample_posterior(
    path: str | Path, recording: Recording, count: int, seed: int = 0, build_start: ClothBuilder | None = None
) -> list[Cloth]:
    """Return ``count`` cloths of an episode: one at a fit's values, others sampled from their joint errors.

    Errors are Gaussian in the stored coordinate (the logarithm of positive parameters) and correlated as the fit says.
    They reach at most three standard errors, in a logarithm or logit at most a factor of ten. Amplitudes without a sign
    stop at zero.

    Args:
        path: identification.json, or the folder that holds it.
        recording: an episode of the same cloth, fitted or not.
        count: number of cloths, the best one included.
        seed: of the random numbers.
        build_start: for a fit that began with a .tcm file: ``diagnosis.make_start_builder(path)``.

    Raises:
        InvalidInput: there is no such file, or the fit is of another model.
        RecordingError: the file cannot be read, or does not hold what is needed.
    """
    fit, rng = read_saved_fit(path), np.random.default_rng(seed)
    cloths = [rebuild_fitted_cloth(path, fit, recording, build_start)]
    values, vectors = np.linalg.eigh(fit.correlation)
    root = vectors * np.sqrt(values.clip(min=0.0))
    for _ in range(count - 1):
        cloth = rebuild_fitted_cloth(path, fit, recording, build_start)
        paths = find_scalar_parameters(cloth)
        z_scores = (root @ rng.standard_normal(len(root))).clip(-MAX_SAMPLE_STD_ERRORS, MAX_SAMPLE_STD_ERRORS)
        for (name, std), z in zip(fit.stds.items(), z_scores, strict=True):
            if name in paths and math.isfinite(std):
                _shift_parameter(cloth.get_submodule(paths[name]), std, float(z))  # type: ignore[arg-type]
        cloth.clip_()
        cloths.append(cloth)
    return cloths


def _shift_parameter(parameter: PhysicalParameter, std: float, z: float) -> None:
    """Shift by ``z`` standard errors [physical unit] in the stored coordinate."""
    raw = parameter.raw.detach().clone().requires_grad_()
    (slope,) = torch.autograd.grad(to_physical(raw, parameter.domain).sum(), raw)
    with torch.no_grad():
        step = z * std / slope
        is_untransformed = parameter.domain in UNTRANSFORMED_DOMAINS
        parameter.raw.add_(step if is_untransformed else step.clamp(-LOG_DECADE, LOG_DECADE))
