"""Estimates of parameters: from covariance to physical values, standard errors and intervals."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from torch import Tensor

from ..._utils.constants import Z_95
from ...cloth import Cloth
from ...episodes.observed import Episode
from ...episodes.unknowns import (
    IDENTIFIABILITY_CRITERIA,
    IdentifiabilityCriteria,
    Unknown,
    collect_unknowns,
    find_scalar_parameters,
    needs_contact,
)
from ...materials import AEP
from ..nuisances import NuisanceSlice


@dataclass(frozen=True)
class Estimate:
    """One parameter with its standard error.

    Attributes:
        value: in ``unit``.
        std: standard error, in ``unit``.
        ci95: 95 % interval, in ``unit``.
        unit: of the parameter.
        initial: start value, in ``unit``.
        identifiable: the standard error is below 25 % of the larger of the value and its typical size. It is also below
            half of the prior's standard deviation in the unconstrained coordinate, unless the prior was measured
            (``episodes.unknowns.IdentifiabilityCriteria``). No parameter is identifiable where the fit means nothing
            (``withdraw_estimates``). A nuisance needs only the second condition.
        source: "data", "prior" (a measurement that the recording states), "derived", "not in the model",
            "held fixed" or "nuisance".
    """

    value: float
    std: float
    ci95: tuple[float, float]
    unit: str
    initial: float
    identifiable: bool
    source: str = "data"


@dataclass(frozen=True)
class InfluenceStatement:
    """How far one parameter moves the cloth, and what would determine it.

    Attributes:
        identifiable: as in ``Estimate``.
        statement: the same in words.
        displacement_per_prior_std_mm: rms displacement [mm] by one standard deviation of the prior.
        displacement_per_10_percent_mm: rms displacement [mm] by 10 % of the value.
        force_per_prior_std_n: rms force change [N] by one standard deviation of the prior.
        force_per_10_percent_n: rms force change [N] by 10 % of the value.
        experiment: motion that would determine the parameter. Empty where it is identified.
    """

    identifiable: bool
    statement: str
    displacement_per_prior_std_mm: float
    displacement_per_10_percent_mm: float
    force_per_prior_std_n: float
    force_per_10_percent_n: float
    experiment: str


@dataclass(frozen=True)
class Profile:
    """How the cost of the best fit rises with one parameter.

    Attributes:
        values: physical values at which the other parameters were fitted anew.
        cost_rise: above the optimum's cost, scaled to the curvature of the standard error: 1.92 at an interval's end.
        ci95: 95 % interval; None at an end where the cost does not rise enough.
        skew: upper over lower part of the interval, in the unconstrained coordinate; None where an end is open.
    """

    values: list[float]
    cost_rise: list[float]
    ci95: tuple[float | None, float | None]
    skew: float | None


@dataclass(frozen=True)
class Combination:
    """A product of powers of parameters (near zero a sum), with the relative error that the data leave of it.

    Attributes:
        powers: exponent by parameter name.
        std: relative standard error.
        determined: whether it is known well.
    """

    powers: dict[str, float]
    std: float
    determined: bool

    @property
    def text(self) -> str:
        """Formula, e.g. "youngs_modulus · areal_density^-0.97"."""
        return " · ".join(n if abs(p - 1) < 0.005 else f"{n}^{p:.2g}" for n, p in self.powers.items())


class EstimateSet(NamedTuple):
    """Estimates and their correlation.

    Attributes:
        parameters: by name.
        correlation: of the fitted parameters, name -> name -> correlation.
    """

    parameters: dict[str, Estimate]
    correlation: dict[str, dict[str, float]]


def make_estimates(
    cloth: Cloth,
    unknowns: Sequence[Unknown],
    raw: Tensor,
    covariance: Tensor,
    criteria: IdentifiabilityCriteria = IDENTIFIABILITY_CRITERIA,
) -> EstimateSet:
    """Compute physical values, standard errors (delta method) and 95 % intervals (in the unconstrained coordinate).

    Args:
        cloth: the model; its material's parameters that were not fitted are listed with their priors.
        unknowns: the fitted parameters.
        raw: [K] unconstrained solution.
        covariance: [K, K] of it.
        criteria: what counts as identified.
    """
    deviation = covariance.diagonal().sqrt()
    triples = zip(unknowns, raw, deviation, strict=False)
    parameters = {u.name: _estimate(u, float(r), float(s), criteria) for u, r, s in triples}
    if isinstance(cloth.material, AEP) and "youngs_modulus" in parameters:
        stiffness = _scale_estimate(parameters["youngs_modulus"], cloth.material.thickness, "N/m")
        parameters = {"membrane_stiffness": stiffness, **parameters}
    paths = find_scalar_parameters(cloth)
    absent = [name for name, path in paths.items() if path.startswith("material.") and name not in parameters]
    for unknown in collect_unknowns(cloth, absent, None, absent=True):
        is_outside = needs_contact(cloth, unknown.key.removesuffix(".raw"))
        parameters[unknown.name] = _prior_estimate(unknown, "not in the model" if is_outside else "held fixed")
    matrix = covariance / deviation[:, None] / deviation[None, :]
    names = [u.name for u in unknowns]
    correlation = {a: {b: float(matrix[i, j]) for j, b in enumerate(names)} for i, a in enumerate(names)}
    return EstimateSet(parameters, correlation)


def make_nuisance_estimates(
    episodes: Sequence[Episode],
    nuisance_slices: Sequence[Sequence[NuisanceSlice]],
    raw: Tensor,
    covariance: Tensor,
    withdrawn: bool = False,
    criteria: IdentifiabilityCriteria = IDENTIFIABILITY_CRITERIA,
) -> dict[str, dict[str, Estimate]]:
    """Return estimates of every episode's nuisances; one is identified when the data say more than its prior.

    Args:
        episodes: of the fit.
        nuisance_slices: where their nuisances stand among the unknowns.
        raw: [K] unconstrained solution.
        covariance: [K, K] of it.
        withdrawn: the fit means nothing, and errors are the priors', as in ``withdraw_estimates``.
        criteria: what counts as identified.
    """
    deviation, out = covariance.diagonal().sqrt(), {}
    for i, (episode, slices) in enumerate(zip(episodes, nuisance_slices, strict=True)):
        name = episode.name if episode.name not in out else f"{episode.name} ({i + 1})"
        out[name] = {}
        for s in slices:
            values, stds = raw[s.index].tolist(), deviation[s.index].tolist()
            for part, unit, prior, value, std in zip(s.names, s.units, s.stds, values, stds, strict=True):
                half_width = Z_95 * std
                interval = (value - half_width, value + half_width)
                identifiable = std < criteria.max_std_over_prior_std * prior and not withdrawn
                if withdrawn:
                    std = math.hypot(prior, value)
                    half_width = Z_95 * prior
                    interval = (min(-half_width, value), max(half_width, value))
                out[name][part] = Estimate(value, std, interval, unit, 0.0, identifiable, "nuisance")
    return out


def withdraw_estimates(
    estimates: EstimateSet, unknowns: Sequence[Unknown], raw: Tensor, names: Collection[str] | None = None
) -> EstimateSet:
    """Return the estimates with none identified and the priors' errors: the model does not describe the data.

    A parameter that was measured beforehand is withdrawn too, because the fit's value is not the measured one.
    Standard errors are of values at the end of the fit and include the distance from the prior's mean. Intervals reach
    over both.

    Args:
        estimates: of the fit.
        unknowns: the fitted parameters.
        raw: [K] where the fit ended.
        names: those that are withdrawn; None: all.
    """
    withdrawn = set(estimates.parameters if names is None else names)
    if names is not None and "youngs_modulus" in withdrawn:
        withdrawn.add("membrane_stiffness")
    prior = {u.name: _prior_estimate(u, "data") for u in unknowns}
    ends = zip(unknowns, raw.tolist(), strict=False)
    stds = {u.name: u.slope(r) * math.hypot(u.prior_std, r - u.prior_mean) for u, r in ends}
    parameters = dict(estimates.parameters)
    for name, e in estimates.parameters.items():
        if name not in withdrawn:
            continue
        if name in prior:
            p = prior[name]
            interval = (min(p.ci95[0], e.value), max(p.ci95[1], e.value))
            parameters[name] = replace(e, std=stds[name], ci95=interval, identifiable=False)
        else:
            parameters[name] = replace(e, identifiable=False)
    if {"membrane_stiffness", "youngs_modulus"} <= withdrawn & set(parameters):
        thickness = estimates.parameters["membrane_stiffness"].value / estimates.parameters["youngs_modulus"].value
        parameters["membrane_stiffness"] = _scale_estimate(parameters["youngs_modulus"], thickness, "N/m")
    return estimates._replace(parameters=parameters)


def apply_profiles(estimates: EstimateSet, profiles: Mapping[str, Profile]) -> EstimateSet:
    """Return the estimates with the intervals of those profiles that have both ends."""
    parameters = dict(estimates.parameters)
    for name, profile in profiles.items():
        low, high = profile.ci95
        if low is not None and high is not None:
            parameters[name] = replace(parameters[name], ci95=(low, high))
            if name == "youngs_modulus" and "membrane_stiffness" in parameters:
                thickness = parameters["membrane_stiffness"].value / parameters[name].value
                parameters["membrane_stiffness"] = _scale_estimate(parameters[name], thickness, "N/m")
    return estimates._replace(parameters=parameters)


def _estimate(unknown: Unknown, raw: float, deviation: float, criteria: IdentifiabilityCriteria) -> Estimate:
    value = unknown.value(raw)
    deviation = min(deviation, unknown.prior_std)  # errors that are considered may add up to more than is known anyway
    std = unknown.slope(raw) * deviation
    half_width = Z_95 * deviation
    low, high = (unknown.value(unknown.clip(raw + sign * half_width)) for sign in (-1, 1))
    # a default prior is no knowledge, a measured one is
    is_informed = unknown.measured or deviation < criteria.max_std_over_prior_std * unknown.prior_std
    identifiable = is_informed and criteria.is_precise(std, value, unknown.typical_amplitude)
    source = "prior" if unknown.measured else "data"
    initial = unknown.value(unknown.start)
    return Estimate(value, std, (low, high), unknown.parameter.unit, initial, identifiable, source)


def _prior_estimate(unknown: Unknown, source: str) -> Estimate:
    """Estimate of a material parameter that was not fitted: only its prior is known."""
    value, half_width = unknown.value(unknown.prior_mean), Z_95 * unknown.prior_std
    low, high = (unknown.value(unknown.clip(unknown.prior_mean + sign * half_width)) for sign in (-1, 1))
    std = unknown.slope(unknown.prior_mean) * unknown.prior_std
    return Estimate(value, std, (low, high), unknown.parameter.unit, value, False, source)


def _scale_estimate(estimate: Estimate, factor: float, unit: str) -> Estimate:
    low, high = estimate.ci95
    return replace(
        estimate,
        value=estimate.value * factor,
        std=estimate.std * factor,
        ci95=(low * factor, high * factor),
        unit=unit,
        initial=estimate.initial * factor,
        source="derived",
    )
