"""What the ablation measures: rescaled parameters, distances of shapes, shares of the energy, agreement of ranks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from torchcloth.dynamics import substep
from torchcloth.dynamics.model import Model
from torchcloth.errors import InvalidInput
from torchcloth.losses import chamfer_to_vertices
from torchcloth.types import ClothState

WITHOUT = ("E", "nu", "k", "gamma", "nu = 0")  # the last: nu put to 0 in mu as well, not only its term left out


def unbounded(nu: float) -> float:
    """The paper's f(nu) = 1 / (0.5 - nu) - 2: from [0, 0.5) to [0, inf), increasing."""
    if not 0 <= nu < 0.5:
        raise InvalidInput("nu", got=f"{nu:g}", expected="a value in [0, 0.5)")
    return 1 / (0.5 - nu) - 2


def bounded(f: float) -> float:
    """The inverse of ``unbounded``."""
    if not f >= 0:
        raise InvalidInput("f(nu)", got=f"{f:g}", expected="a value >= 0")
    return 0.5 - 1 / (f + 2) if f < float("inf") else 0.5


def scaled_poisson(nu: float, scale: float) -> float:
    """Poisson's ratio at ``scale`` (1 = unchanged), scaled where it is unbounded: never outside [0, 0.5)."""
    return bounded(scale * unbounded(nu))


def bidirectional_chamfer(a: Tensor, b: Tensor) -> float:
    """Sum of both one-sided Chamfer distances [m] between clouds [N, 3] and [M, 3] m: mean distance to the nearest."""
    return float(chamfer_to_vertices(a, b) + chamfer_to_vertices(b, a))


def energies(model: Model, state: ClothState) -> dict[str, Tensor]:
    """Elastic energy [...] J of a state, and what is left of it without each parameter, by ``WITHOUT``.

    The terms of the paper's energy density: E carries the whole membrane, nu the term lambda/2 (J - 1)^2, k and gamma
    their own of the director.
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


def contributions(energy: dict[str, np.ndarray]) -> dict[str, float]:
    """The paper's C^j = (W - W^j) / W with W the mean over a motion's frames of ``energies`` [T] J."""
    total = float(np.mean(energy["total"]))
    return {j: (total - float(np.mean(energy[j]))) / total for j in WITHOUT}


def spearman(a: Sequence[float], b: Sequence[float]) -> float:
    """Spearman's rank correlation, ties share their mean rank; NaN where one side is constant."""
    if len(a) != len(b) or len(a) < 2:
        raise InvalidInput("ranks", got=f"{len(a)} and {len(b)} values", expected="equally many, two or more")
    ranks = [_ranks(np.asarray(values, dtype=float)) for values in (a, b)]
    spread = [r - r.mean() for r in ranks]
    scale = float(np.sqrt((spread[0] ** 2).sum() * (spread[1] ** 2).sum()))
    return float((spread[0] * spread[1]).sum()) / scale if scale > 0 else float("nan")


def _ranks(values: np.ndarray) -> np.ndarray:
    _, inverse, count = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(count)
    return ((2 * last - count + 1) / 2)[inverse]
