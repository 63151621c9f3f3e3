"""Measures of the ablation: rescaled parameters, distances of shapes, energy contributions, rank correlation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.stats import spearmanr
from torch import Tensor

from torchcloth.dynamics import substep
from torchcloth.dynamics.model import Model
from torchcloth.errors import InvalidInput
from torchcloth.losses import chamfer_to_vertices
from torchcloth.types import ClothState

LEFT_OUT_TERMS = ("E", "nu", "k", "gamma", "nu = 0")  # "nu = 0" sets nu to 0 in mu as well; "nu" drops its term only
CHAOS_FACTOR = 3.0  # distances below this multiple of the effect of a start moved by 1 um are not significant


def to_unbounded_poisson(nu: float) -> float:
    """Return the paper's f(nu) = 1 / (0.5 - nu) - 2, which maps [0, 0.5) to [0, inf) and increases."""
    if not 0 <= nu < 0.5:
        raise InvalidInput("nu", got=f"{nu:g}", expected="a value in [0, 0.5)")
    return 1 / (0.5 - nu) - 2


def from_unbounded_poisson(f: float) -> float:
    """Return the inverse of ``to_unbounded_poisson``."""
    if not f >= 0:
        raise InvalidInput("f(nu)", got=f"{f:g}", expected="a value >= 0")
    return 0.5 - 1 / (f + 2) if f < float("inf") else 0.5


def scaled_poisson(nu: float, scale: float) -> float:
    """Scale Poisson's ratio in its unbounded form, so that it stays in [0, 0.5)."""
    return from_unbounded_poisson(scale * to_unbounded_poisson(nu))


def bidirectional_chamfer(a: Tensor, b: Tensor) -> float:
    """Return the sum of both one-sided Chamfer distances [m] (mean nearest distance) of clouds [N, 3], [M, 3] m."""
    return float(chamfer_to_vertices(a, b) + chamfer_to_vertices(b, a))


def energies_without_each(model: Model, state: ClothState) -> dict[str, Tensor]:
    """Return the elastic energy [...] J of a state, "total" and without the terms of each of ``LEFT_OUT_TERMS``.

    In the paper's energy density, E carries the whole membrane, nu the term lambda/2 (J - 1)^2, and k and gamma their
    terms of the director.
    """
    c = model.coefficients
    ratio = c.lam / (2 * c.mu)  # nu / (1 - 2 nu) in the paper's convention
    nu = ratio / (1 + 2 * ratio)
    without = {
        "E": {"mu": 0 * c.mu, "lam": 0 * c.lam},
        "nu": {"lam": 0 * c.lam},
        "k": {"contact": 0 * c.contact},
        "gamma": {"shear": 0 * c.shear},
        "nu = 0": {"mu": c.mu * (1 + nu), "lam": 0 * c.lam},
    }
    total = _elastic(model, state)
    return {"total": total} | {
        j: _elastic(model._replace(coefficients=c._replace(**w)), state) for j, w in without.items()
    }


def _elastic(model: Model, state: ClothState) -> Tensor:
    energy = substep.energy(model, state)
    return energy["membrane"] + energy.get("director", torch.zeros(()))


def energy_contributions(energy: dict[str, np.ndarray]) -> dict[str, float]:
    """Return the paper's C^j = (W - W^j) / W, where W is the mean energy [J] over the frames of a motion."""
    total = float(np.mean(energy["total"]))
    return {j: (total - float(np.mean(energy[j]))) / total for j in LEFT_OUT_TERMS}


def rank_correlation(a: Sequence[float], b: Sequence[float]) -> float:
    """Return Spearman's rank correlation; NaN if one side is constant."""
    if min(len(set(a)), len(set(b))) < 2:  # scipy would warn
        return float("nan")
    return float(np.asarray(spearmanr(a, b))[0])
