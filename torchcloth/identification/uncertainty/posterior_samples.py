"""Cloths drawn from what a fit leaves open."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch

from ...cloth import Cloth
from ...episodes.unknowns import available
from ...parameters import PhysicalParameter, to_value
from ...recordings import Recording
from ..io.saved_fit import Scene, read_saved, rebuilt

FAR = 3.0  # standard errors, beyond which nothing is drawn
LINEAR = ("nonnegative", "real")  # domains that are stored as they are
DECADE = math.log(10.0)  # likewise, in the stored coordinate: of what a fit knows nothing of


def drawn(path: str | Path, recording: Recording, count: int, seed: int = 0, begun: Scene | None = None) -> list[Cloth]:
    """``count`` cloths of an episode: at a fit's values, then with its parameters drawn from their joint errors.

    Errors are Gaussian in the stored coordinate (the logarithm of positive parameters), correlated as the fit says, and
    at most ``FAR`` standard errors, of a logarithm or logit a factor of ten; amplitudes without a sign stop at zero.

    Args:
        path: identification.json, or the folder that holds it.
        recording: an episode of the same cloth, fitted or not.
        count: how many, the best one included.
        seed: of the draws.
        begun: of a fit that began with a .tcm file: ``diagnosis.start_of(path)``.

    Raises:
        InvalidInput: there is no such file, or the fit is of another model.
        RecordingError: the file cannot be read, or does not hold what is needed.
    """
    model, rng = read_saved(path), np.random.default_rng(seed)
    out = [rebuilt(path, model, recording, begun)]
    values, vectors = np.linalg.eigh(model.correlation)
    root = vectors * np.sqrt(values.clip(min=0.0))
    for _ in range(count - 1):
        cloth = rebuilt(path, model, recording, begun)
        names, noise = available(cloth), (root @ rng.standard_normal(len(root))).clip(-FAR, FAR)
        for (name, std), z in zip(model.stds.items(), noise, strict=True):
            if name in names and math.isfinite(std):
                _move(cloth.get_submodule(names[name]), std, float(z))  # type: ignore[arg-type]
        cloth.clip_()
        out.append(cloth)
    return out


def _move(parameter: PhysicalParameter, std: float, z: float) -> None:
    """By ``z`` standard errors [physical unit] in the stored coordinate."""
    raw = parameter.raw.detach().clone().requires_grad_()
    (slope,) = torch.autograd.grad(to_value(raw, parameter.domain).sum(), raw)
    with torch.no_grad():
        step = z * std / slope
        parameter.raw.add_(step if parameter.domain in LINEAR else step.clamp(-DECADE, DECADE))
