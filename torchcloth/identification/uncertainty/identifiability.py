"""What the data can tell: how far each parameter moves the cloth, what shows only together, and what would help."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fnmatch import fnmatch
from typing import NamedTuple

import torch
from torch import Tensor

from ...episodes.unknowns import Unknown
from .estimates import Combination, Estimate, Influence

TENTH = 0.1
KNOWN = 0.25  # relative error below which a combination is called determined
ROUNDING = 1e-10  # least eigenvalue of a correlation matrix whose inverse means something
SHOWN, ALONE = 0.3, 0.95  # shares of a combination: named from, taken as a parameter of its own from

# What determines a parameter, in the order of the first name that fits.
EXPERIMENTS = (
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


class Reach(NamedTuple):
    """How far a unit of each unknown [K] moves the cloth and its forces, root mean square."""

    position: Tensor  # m, over vertices and frames
    force: Tensor  # N, over grippers and frames


def influences(
    unknowns: Sequence[Unknown], raw: Tensor, reach: Reach, estimates: Mapping[str, Estimate]
) -> dict[str, Influence]:
    """By the parameter's name."""
    out = {}
    for k, unknown in enumerate(unknowns):
        tenth, prior = TENTH * _relative(unknown, float(raw[k])), unknown.prior_std
        position, force = 1e3 * float(reach.position[k]), float(reach.force[k])
        identifiable = estimates[unknown.name].identifiable
        statement = "identified" if identifiable else "not identifiable from these data"
        if position == 0.0 and force == 0.0:
            statement = "no effect on these data"
        experiment = "" if identifiable else experiment_for(unknown.name)
        out[unknown.name] = Influence(
            identifiable, statement, position * prior, position * tenth, force * prior, force * tenth, experiment
        )
    return out


def combinations(unknowns: Sequence[Unknown], raw: Tensor, covariance: Tensor) -> list[Combination]:
    """Eigenvectors of the data's information in relative coordinates, best determined first.

    Nuisances are allowed for; priors are taken out. Directions that are one parameter are left out. A covariance that
    is singular to rounding, as of a motion with runaway slopes, has none.
    """
    count = len(unknowns)
    prior = torch.tensor([u.prior_std for u in unknowns], dtype=covariance.dtype)
    unit = torch.tensor([_relative(u, float(r)) for u, r in zip(unknowns, raw, strict=False)], dtype=covariance.dtype)
    within = covariance[:count, :count]
    deviation = within.diagonal().sqrt()
    correlation = within / deviation[:, None] / deviation
    if not bool(correlation.isfinite().all()) or float(torch.linalg.eigvalsh(correlation)[0]) < ROUNDING:
        return []
    information = torch.linalg.inv(correlation) / deviation[:, None] / deviation - torch.diag(prior**-2)
    values, vectors = torch.linalg.eigh(unit[:, None] * information * unit)
    out = []
    for value, vector in zip(values.flip(0), vectors.flip(1).mT, strict=True):
        size = float(vector.abs().max())
        if size > ALONE or float(value) <= 0:
            continue
        vector = vector / vector[vector.abs().argmax()]
        named = [k for k in vector.abs().argsort(descending=True).tolist() if abs(float(vector[k])) > SHOWN]
        if len(named) < 2:
            continue
        std = 1 / (float(value) ** 0.5 * size)
        out.append(Combination({unknowns[k].name: float(vector[k]) for k in named}, std, std < KNOWN))
    return out


def experiment_for(name: str) -> str:
    """What would determine a parameter."""
    return next((text for pattern, text in EXPERIMENTS if fnmatch(name, pattern)), "a motion that moves it more")


def _relative(unknown: Unknown, raw: float) -> float:
    """Change of the unconstrained number for a change by the value itself; of a typical value, where that is larger."""
    return max(abs(unknown.value(raw)), unknown.typical) / unknown.slope(raw)
