"""From covariance to statements: estimates, identifiability, warnings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from ...cloth import Cloth
from ...episodes.observed import Episode
from ...episodes.unknowns import TOLD, TRUSTED, Unknown, available, collect, needs_contact
from ...materials import AEP
from ..estimators.levenberg_marquardt import NORMAL
from ..estimators.linearity import Checked
from ..estimators.objective import Objective
from ..nuisances import Placed
from .consider_covariance import covariance_of
from .estimates import Estimate, Profile

MISSED = 1.3  # rms over the sensor noise above which what the model misses may matter more than the noise
STEADY = 0.9  # of the rms distance from constant forces, above which nothing but a weight was seen in them
CONFUSED = 0.95  # correlation above which two parameters are called hard to tell apart


class Found(NamedTuple):
    """Estimates and their correlation."""

    parameters: dict[str, Estimate]
    correlation: dict[str, dict[str, float]]


def estimates(cloth: Cloth, unknowns: Sequence[Unknown], raw: Tensor, covariance: Tensor) -> Found:
    """Physical values, standard errors (delta method), 95 % intervals (in the unconstrained coordinate)."""
    deviation = covariance.diagonal().sqrt()
    parameters = {u.name: _estimate(u, float(r), float(s)) for u, r, s in zip(unknowns, raw, deviation, strict=False)}
    if isinstance(cloth.material, AEP) and "youngs_modulus" in parameters:
        parameters = {
            "membrane_stiffness": _times(parameters["youngs_modulus"], cloth.material.thickness, "N/m"),
            **parameters,
        }
    absent = [
        name for name, path in available(cloth).items() if path.startswith("material.") and name not in parameters
    ]
    for unknown in collect(cloth, absent, None, absent=True):
        outside = needs_contact(cloth, unknown.key.removesuffix(".raw"))
        parameters[unknown.name] = _absent(unknown, "not in the model" if outside else "held fixed")
    matrix = covariance / deviation[:, None] / deviation[None, :]
    names = [u.name for u in unknowns]
    correlation = {a: {b: float(matrix[i, j]) for j, b in enumerate(names)} for i, a in enumerate(names)}
    return Found(parameters, correlation)


def undecided(objective: Objective, checked: Checked, strata: Tensor | None) -> list[str]:
    """Fitted parameters that a solution leaves open; ``strata`` as of ``covariance_of``."""
    covariance = covariance_of(objective, checked, strata)
    found = estimates(objective.cloth, objective.unknowns, checked.final.raw, covariance)
    return [u.name for u in objective.unknowns if not (u.measured or found.parameters[u.name].identifiable)]


def nuisance_estimates(
    episodes: Sequence[Episode],
    placed: Sequence[Sequence[Placed]],
    raw: Tensor,
    covariance: Tensor,
    withdrawn: bool = False,
) -> dict[str, dict[str, Estimate]]:
    """For every episode what was found of its nuisances; known when the data say more than the prior.

    ``withdrawn``: the fit means nothing, and errors are the priors', as of ``withdraw``.
    """
    deviation, out = covariance.diagonal().sqrt(), {}
    for i, (episode, own) in enumerate(zip(episodes, placed, strict=True)):
        name = episode.name if episode.name not in out else f"{episode.name} ({i + 1})"
        out[name] = {}
        for p in own:
            numbers = zip(p.names, p.units, p.stds, raw[p.where].tolist(), deviation[p.where].tolist(), strict=True)
            for part, unit, prior, value, std in numbers:
                interval = (value - NORMAL * std, value + NORMAL * std)
                known = std < 0.5 * prior and not withdrawn
                if withdrawn:
                    std = math.hypot(prior, value)
                    interval = (min(-NORMAL * prior, value), max(NORMAL * prior, value))
                out[name][part] = Estimate(value, std, interval, unit, 0.0, known, "nuisance")
    return out


def withdraw(found: Found, unknowns: Sequence[Unknown], raw: Tensor) -> Found:
    """No parameter counts as identified, because the model does not describe these data: errors are the priors'.

    Nor one that was measured beforehand: the fit's value of it is not the measured one. ``raw``: where the fit ended;
    standard errors are of values there, with the way from the prior's middle, and intervals reach over both.
    """
    prior = {u.name: _absent(u, "data") for u in unknowns}
    ends = zip(unknowns, raw.tolist(), strict=False)
    stds = {u.name: u.slope(r) * math.hypot(u.prior_std, r - u.middle) for u, r in ends}
    parameters = dict(found.parameters)
    for name, e in found.parameters.items():
        if name in prior:
            p = prior[name]
            interval = (min(p.ci95[0], e.value), max(p.ci95[1], e.value))
            parameters[name] = replace(e, std=stds[name], ci95=interval, identifiable=False)
        else:
            parameters[name] = replace(e, identifiable=False)
    if "membrane_stiffness" in parameters and "youngs_modulus" in parameters:
        thickness = found.parameters["membrane_stiffness"].value / found.parameters["youngs_modulus"].value
        parameters["membrane_stiffness"] = _times(parameters["youngs_modulus"], thickness, "N/m")
    return found._replace(parameters=parameters)


def with_profiles(found: Found, profiles: Mapping[str, Profile]) -> Found:
    """Intervals of the profiles that have both ends."""
    parameters = dict(found.parameters)
    for name, profile in profiles.items():
        low, high = profile.ci95
        if low is not None and high is not None:
            parameters[name] = replace(parameters[name], ci95=(low, high))
            if name == "youngs_modulus" and "membrane_stiffness" in parameters:
                thickness = parameters["membrane_stiffness"].value / parameters[name].value
                parameters["membrane_stiffness"] = _times(parameters[name], thickness, "N/m")
    return found._replace(parameters=parameters)


def skewed(found: Found, curved: Sequence[str]) -> list[str]:
    """Offers a profile where the slope changes over a standard error."""
    names = [name for name in curved if found.parameters[name].identifiable and found.parameters[name].source == "data"]
    if not names:
        return []
    return [
        f"the intervals of {', '.join(names)} may be longer to one side (their slopes change within a standard error): "
        f"profile (--profile {' '.join(names)}) shows it"
    ]


def doubts(found: Found) -> list[str]:
    """Which fitted parameters the data do not tell, or do not tell apart."""
    out = []
    for name, estimate in found.parameters.items():
        if not estimate.identifiable and estimate.source == "data":
            out.append(f"{name} is not identifiable from these data: its value is no estimate")
    names = [n for n in found.correlation if found.parameters[n].source == "data"]
    for i, a in enumerate(names):
        for b in names[:i]:
            if abs(found.correlation[a][b]) > CONFUSED:
                out.append(f"{a} and {b} can hardly be told apart (correlation {found.correlation[a][b]:+.2f})")
    return out


def warnings_of(
    cloth: Cloth,
    episodes: Sequence[Episode],
    found: Found,
    fit: dict[str, float],
    frames: Sequence[Tensor],
    faces: Tensor,
    null: str = "",
) -> list[str]:
    """What a reader must know before he uses the numbers; ``null``: ``no_better_than``."""
    out = []
    if null:
        out.append(f"the fit is no better than {null}: these data say nothing about it")
    elif math.isnan(fit["chamfer_after"]) and fit["force_rms_after"] >= STEADY * fit["force_rms_constant"]:
        out.append("constant forces would do as well: these data weigh the cloth and say little else")
    if fit["chamfer_after"] > fit["chamfer_before"]:
        out.append(
            "the fitted values are farther from the points than the start: the robust cost fell, the mean did not"
        )
    out += doubts(found)
    if "areal_density" not in found.correlation:
        out.append(
            "areal density was taken as exact: without force readings stiffness and density enter only as a ratio"
        )
    noise = [e.noise for e in episodes if e.noise]
    if noise and fit["rms_after"] > MISSED * max(noise):
        out.append(
            f"the residual ({fit['rms_after'] * 1e3:.1f} mm rms) exceeds {MISSED:g} times the sensor noise "
            f"({max(noise) * 1e3:.1f} mm): the model misses something, and the standard errors do not cover it"
        )
    if not all(e.settles for e in episodes):
        out.append(
            "an episode has no initial_vertices: the rest mesh, as placed in the file, was taken as the first frame"
        )
    out += [doubt for e in episodes for doubt in e.doubts()]
    if cloth.contact is None and _layers_meet(cloth, frames, faces):
        out.append("layers of the cloth come near each other, and contact was left out: fit with contact")
    return out


def _estimate(unknown: Unknown, raw: float, deviation: float) -> Estimate:
    value = unknown.value(raw)
    std = unknown.slope(raw) * deviation
    low, high = (unknown.value(unknown.clip(raw + sign * NORMAL * deviation)) for sign in (-1, 1))
    told = unknown.measured or deviation < TOLD * unknown.prior_std  # a default prior is no knowledge
    identifiable = told and std < TRUSTED * max(abs(value), unknown.typical)
    return Estimate(
        value,
        std,
        (low, high),
        unknown.parameter.unit,
        unknown.value(unknown.start),
        identifiable,
        "prior" if unknown.measured else "data",
    )


def _absent(unknown: Unknown, source: str) -> Estimate:
    """A material parameter that was not fitted: only its prior is known."""
    value, spread = unknown.value(unknown.middle), NORMAL * unknown.prior_std
    low, high = (unknown.value(unknown.clip(unknown.middle + sign * spread)) for sign in (-1, 1))
    std = unknown.slope(unknown.middle) * unknown.prior_std
    return Estimate(value, std, (low, high), unknown.parameter.unit, value, False, source)


def _times(estimate: Estimate, factor: float, unit: str) -> Estimate:
    low, high = estimate.ci95
    return Estimate(
        estimate.value * factor,
        estimate.std * factor,
        (low * factor, high * factor),
        unit,
        estimate.initial * factor,
        estimate.identifiable,
        "derived",
    )


def _layers_meet(cloth: Cloth, frames: Sequence[Tensor], faces: Tensor) -> bool:
    """Whether triangles that are far apart in the fabric come within 1.5 edges of each other."""
    rest = torch.as_tensor(cloth.mesh.vertices, dtype=frames[0].dtype)[faces].mean(1)
    edge = cloth.mesh.mean_edge
    apart = torch.cdist(rest, rest) > 4 * edge
    for motion in frames:
        for x in motion[:: max(1, len(motion) // 8)]:
            centres = x[faces].mean(1)
            if bool(((torch.cdist(centres, centres) < 1.5 * edge) & apart).any()):
                return True
    return False
