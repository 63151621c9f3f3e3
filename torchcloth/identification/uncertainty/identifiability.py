"""What the data can determine: how far each parameter moves the cloth, which are confounded, and what would help."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from typing import NamedTuple

import torch
from torch import Tensor

from ...episodes.unknowns import Unknown
from .estimates import Combination, Estimate, InfluenceStatement


@dataclass(frozen=True)
class CombinationCriteria:
    """Which combinations of parameters are reported.

    Attributes:
        max_relative_std: relative error below which a combination counts as determined.
        min_correlation_eigenvalue: least eigenvalue of a correlation matrix whose inverse means something.
        min_named_weight: weight in a combination, relative to the largest, from which a parameter is named.
        max_single_weight: weight from which a combination is one parameter, which has its own estimate.
    """

    max_relative_std: float = 0.25
    min_correlation_eigenvalue: float = 1e-10
    min_named_weight: float = 0.3
    max_single_weight: float = 0.95


COMBINATION_CRITERIA = CombinationCriteria()
STATED_VALUE_FRACTION = 0.1  # of a parameter's value, whose effect is reported

# What determines a parameter, in the order of the first name that fits.
EXPERIMENT_BY_PARAMETER = (
    ("*modulus", "stretch it by some 5 % between two grippers that measure force; once along each axis and the bias"),
    ("*stiffening", "stretch it until it is taut, with force readings"),
    ("poisson_ratio", "stretch it with the free edges, or markers, in view"),
    ("areal_density", "weigh it, or let it hang still from a force sensor"),
    ("contact_stiffness", "press folded layers together (fit with contact)"),
    ("shear_stiffness", "compress it and fold it onto itself (fit with contact)"),
    ("cone", "drag one folded layer over another (fit with contact)"),
    ("*viscosity", "pluck it while it is taut"),
    ("*damping*", "let it swing out, with ripples of a hand's width in view"),
    ("*bending*", "let it overhang an edge, or hang close to a clamp that is in view"),
    ("air.normal", "swing it broadside, fast (1 m/s)"),
    ("air.tangential", "draw it fast along its own plane"),
    ("*air*", "swing it broadside at two speeds"),
    ("*length", "swing it at one amplitude and several frequencies"),
    ("*shrink*", "lay it flat and look at its outline"),
    ("*skew", "lay it flat and look at its outline"),
    ("*mass_per_length", "weigh it, and let it hang from the middle of an edge"),
    ("*grip*", "pull hard, and look at the held places"),
    ("*hysteresis", "shear it to and fro, slowly, with force readings"),
    ("*moment", "bend it to and fro, slowly"),
)


class ParameterInfluence(NamedTuple):
    """How far a unit of each unknown [K] moves the cloth and its forces, root mean square.

    Attributes:
        position: [K] m, over vertices and frames.
        force: [K] N, over grippers and frames.
    """

    position: Tensor
    force: Tensor


def describe_influences(
    unknowns: Sequence[Unknown], raw: Tensor, influence: ParameterInfluence, estimates: Mapping[str, Estimate]
) -> dict[str, InfluenceStatement]:
    """Describe by parameter name how far each unknown moves the cloth, and what would determine it."""
    out = {}
    for k, unknown in enumerate(unknowns):
        prior, fraction = unknown.prior_std, STATED_VALUE_FRACTION * _raw_change_per_value(unknown, float(raw[k]))
        position_mm, force = 1e3 * float(influence.position[k]), float(influence.force[k])
        identifiable = estimates[unknown.name].identifiable
        statement = "identified" if identifiable else "not identifiable from these data"
        if position_mm == 0.0 and force == 0.0:
            statement = "no effect on these data"
        out[unknown.name] = InfluenceStatement(
            identifiable=identifiable,
            statement=statement,
            displacement_per_prior_std_mm=position_mm * prior,
            displacement_per_10_percent_mm=position_mm * fraction,
            force_per_prior_std_n=force * prior,
            force_per_10_percent_n=force * fraction,
            experiment="" if identifiable else suggest_experiment(unknown.name),
        )
    return out


def find_combinations(
    unknowns: Sequence[Unknown],
    raw: Tensor,
    covariance: Tensor,
    criteria: CombinationCriteria = COMBINATION_CRITERIA,
) -> list[Combination]:
    """Return eigenvectors of the data's information in relative coordinates, best determined first.

    Nuisances are allowed for, priors are taken out. Directions that are one parameter are left out. A covariance that
    is singular to rounding, as for a motion with runaway slopes, has no combinations.
    """
    count = len(unknowns)
    prior = torch.tensor([u.prior_std for u in unknowns], dtype=covariance.dtype)
    changes = [_raw_change_per_value(u, float(r)) for u, r in zip(unknowns, raw, strict=False)]
    unit = torch.tensor(changes, dtype=covariance.dtype)
    fabric = covariance[:count, :count]
    deviation = fabric.diagonal().sqrt()
    correlation = fabric / deviation[:, None] / deviation
    if not bool(correlation.isfinite().all()):
        return []
    if float(torch.linalg.eigvalsh(correlation)[0]) < criteria.min_correlation_eigenvalue:
        return []
    information = torch.linalg.inv(correlation) / deviation[:, None] / deviation - torch.diag(prior**-2)
    values, vectors = torch.linalg.eigh(unit[:, None] * information * unit)
    out = []
    for value, vector in zip(values.flip(0), vectors.flip(1).mT, strict=True):
        size = float(vector.abs().max())
        if size > criteria.max_single_weight or float(value) <= 0:
            continue
        vector = vector / vector[vector.abs().argmax()]
        order = vector.abs().argsort(descending=True).tolist()
        named = [k for k in order if abs(float(vector[k])) > criteria.min_named_weight]
        if len(named) < 2:
            continue
        std = 1 / (float(value) ** 0.5 * size)
        powers = {unknowns[k].name: float(vector[k]) for k in named}
        out.append(Combination(powers, std, std < criteria.max_relative_std))
    return out


def suggest_experiment(name: str) -> str:
    """Return a motion that would determine a parameter."""
    return next(
        (text for pattern, text in EXPERIMENT_BY_PARAMETER if fnmatch(name, pattern)), "a motion that moves it more"
    )


def _raw_change_per_value(unknown: Unknown, raw: float) -> float:
    """Change of the unconstrained number for a change by the value itself, or by a typical value that is larger."""
    return max(abs(unknown.value(raw)), unknown.typical_amplitude) / unknown.slope(raw)
