"""What a fit may change: parameters by public name, as one unconstrained vector with a prior."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..cloth import Cloth
from ..errors import InvalidInput
from ..parameters import PhysicalParameter, to_physical

LOG_DECADE = math.log(10.0)
POISSON_PRIOR_STD_LOGIT = 1.0  # of logit(2 nu): around 0.2, 95 % of the prior between 0.04 and 0.42
TYPICAL_AMPLITUDES = {"friction": 0.3, "excess": 0.1, "cone": 0.3}  # of parts that are no effects, by parameter name
MISSING_EFFECT_REMEDIES = {  # effects that an episode's facts bring into the model
    "air": "the model has no air: give air.density in episode.json",
    "bending": "the model has no bending: give cloth.nominal.bending_stiffness in episode.json",
}


@dataclass(frozen=True)
class IdentifiabilityCriteria:
    """When a parameter counts as identified.

    Attributes:
        max_relative_std: standard error over the value (or over a typical amplitude that is larger), below which a
            parameter is identified. A given prior that is narrower than this counts as a measurement.
        max_std_over_prior_std: standard error over the prior's standard deviation, in the unconstrained coordinate,
            below which the data contributed something. A measured parameter needs no such contribution.
    """

    max_relative_std: float = 0.25
    max_std_over_prior_std: float = 0.5

    def is_precise(self, std: float, value: float, typical_amplitude: float) -> bool:
        """Tell whether a standard error is small enough beside the value."""
        return std < self.max_relative_std * max(abs(value), typical_amplitude)


IDENTIFIABILITY_CRITERIA = IdentifiabilityCriteria()


@dataclass(frozen=True, eq=False)
class Unknown:
    """One scalar parameter of the fit.

    Attributes:
        name: public name, e.g. "youngs_modulus" or "air.normal".
        key: name of the stored tensor in the cloth's state.
        parameter: the parameter at its start value.
        start: unconstrained start value.
        prior_std: standard deviation of the prior, in the unconstrained coordinate.
        typical_amplitude: typical size of an amplitude, which may be zero, in its unit; 0 for any other parameter.
        measured: known before the fit: a weighed areal density, or a given prior that is narrow enough.
        stated_prior_mean: mean of the prior, unconstrained; None: the start.
    """

    name: str
    key: str
    parameter: PhysicalParameter
    start: float
    prior_std: float
    typical_amplitude: float = 0.0
    measured: bool = False
    stated_prior_mean: float | None = None

    @property
    def prior_mean(self) -> float:
        """Mean of the prior, unconstrained."""
        return self.start if self.stated_prior_mean is None else self.stated_prior_mean

    @property
    def max_step(self) -> float:
        """Longest step of one iteration.

        A factor of 2.7 of a log parameter; of an amplitude a quarter of the prior's standard deviation, or half its
        typical size if that is more.
        """
        return max(0.25 * self.prior_std, 0.5 * self.typical_amplitude) if self.typical_amplitude else 1.0

    @property
    def typical_change(self) -> float:
        """Change that matters: a factor of e of a log parameter, the typical size of an amplitude."""
        return self.typical_amplitude or 1.0

    def value(self, raw: float) -> float:
        """Return the physical value of an unconstrained one."""
        return float(to_physical(torch.tensor(raw, dtype=torch.float64), self.parameter.domain))

    def slope(self, raw: float) -> float:
        """Return the derivative of the physical value by the unconstrained one."""
        x = torch.tensor(raw, dtype=torch.float64, requires_grad=True)
        return float(torch.autograd.grad(to_physical(x, self.parameter.domain), x)[0])

    def clip(self, raw: float) -> float:
        """Return the nearest legal unconstrained value; amplitudes are stored as they are."""
        return max(raw, 0.0) if self.parameter.domain == "nonnegative" else raw


def find_scalar_parameters(cloth: Cloth) -> dict[str, str]:
    """Return the module path of every scalar physical parameter of a cloth, by public name."""
    paths = {}
    for path, module in cloth.named_modules():
        if isinstance(module, PhysicalParameter) and module.raw.ndim == 0:
            head, _, tail = path.partition(".")
            paths[tail if head in ("material", "effects", "boundaries") else path] = path
    return paths


def needs_contact(cloth: Cloth, path: str) -> bool:
    """Tell whether a parameter, given by its module path, does nothing because the model has no contact."""
    return cloth.contact is None and path in [f"material.{name}" for name in cloth.material.contact_parameters]


def collect_unknowns(
    cloth: Cloth, names: Sequence[str], weighed: tuple[float, float] | None, absent: bool = False
) -> list[Unknown]:
    """Return the unknowns of a fit.

    Args:
        cloth: model and start values.
        names: public names of parameters.
        weighed: measured areal density and its standard deviation [kg/m^2]. It joins with this prior, wherever the
            cloth's own value starts.
        absent: admit parameters that the model does not contain, for reports.

    Raises:
        InvalidInput: an unknown name, a field-valued parameter, or one that needs contact.
    """
    paths = find_scalar_parameters(cloth)
    unknowns = []
    for name in dict.fromkeys(names):
        if name not in paths:
            possible = sorted(n for n, path in paths.items() if not needs_contact(cloth, path))
            is_field = isinstance(dict(cloth.material.named_modules()).get(name), PhysicalParameter)
            remedy = MISSING_EFFECT_REMEDIES.get(name.split(".")[0], "")
            remedy = "a value for each triangle: fit_fields" if is_field else remedy
            raise InvalidInput(
                "parameter to fit", got=repr(name), expected=f"one of {', '.join(possible)}", remedy=remedy
            )
        if needs_contact(cloth, paths[name]) and not absent:
            raise InvalidInput(
                "parameter to fit",
                got=repr(name),
                expected="a parameter of the model",
                remedy="it needs contact between layers (cloth.layer_gap of the episode; in a config model.contact)",
            )
        unknowns.append(_make_unknown(cloth, name, paths[name]))
    if weighed and "areal_density" in paths and "areal_density" not in names:
        value, std = weighed
        unknowns.append(
            Unknown(
                name="areal_density",
                key=paths["areal_density"] + ".raw",
                parameter=cloth.areal_density,
                start=float(cloth.areal_density.raw.detach()),
                prior_std=std / value,
                measured=True,
                stated_prior_mean=math.log(value),
            )
        )
    return unknowns


def _make_unknown(cloth: Cloth, name: str, path: str) -> Unknown:
    parameter = cloth.get_submodule(path)
    if not isinstance(parameter, PhysicalParameter):
        raise InvalidInput("parameter to fit", got=repr(name), expected="a scalar physical parameter")
    start = float(parameter.raw.detach())
    typical = 0.0
    if parameter.domain == "positive":
        std = LOG_DECADE
    elif parameter.domain == "unit_half":
        std = POISSON_PRIOR_STD_LOGIT
    else:
        owner, _, attribute = path.rpartition(".")
        amplitude = getattr(cloth.get_submodule(owner), "amplitudes", {}).get(attribute)
        # a part that declares no amplitude: its start says how large it is
        undeclared = TYPICAL_AMPLITUDES.get(attribute, max(1.0, abs(start)))
        typical = undeclared if amplitude is None else amplitude.typical
        std = (2.0 if amplitude is None else amplitude.prior_ratio) * max(typical, abs(start))
    return Unknown(name, f"{path}.raw", parameter, start, std, typical)


def apply_priors(unknowns: Sequence[Unknown], priors: Mapping[str, tuple[float, float]]) -> list[Unknown]:
    """Return the unknowns with given priors.

    Args:
        unknowns: of the fit.
        priors: by name (value, factor) for positive parameters, (value, standard deviation) for others.

    Raises:
        InvalidInput: a name that is not fitted, or numbers that make no prior.
    """
    names = [u.name for u in unknowns]
    for name, pair in priors.items():
        if name not in names:
            raise InvalidInput("priors", got=repr(name), expected=f"some of {', '.join(names)}")
        is_positive = unknowns[names.index(name)].parameter.domain == "positive"
        is_pair = isinstance(pair, Sequence) and len(pair) == 2
        if not is_pair or not (math.isfinite(pair[1]) and pair[1] > (1.0 if is_positive else 0.0)):
            expected = "(value, factor > 1)" if is_positive else "(value, standard deviation > 0)"
            raise InvalidInput(f"prior of {name}", got=pair, expected=expected)
    return [_set_prior(u, *priors[u.name]) if u.name in priors else u for u in unknowns]


def _set_prior(unknown: Unknown, value: float, spread: float) -> Unknown:
    p = unknown.parameter
    mean = float(PhysicalParameter(value, p.unit, p.domain, name=f"prior of {unknown.name}").raw.detach())
    std = math.log(spread) if p.domain == "positive" else spread / unknown.slope(mean)
    is_narrow = IDENTIFIABILITY_CRITERIA.is_precise(unknown.slope(mean) * std, value, unknown.typical_amplitude)
    return replace(unknown, stated_prior_mean=mean, prior_std=std, measured=unknown.measured or is_narrow)


def make_state_entries(unknowns: Sequence[Unknown], raw: Tensor) -> dict[str, Tensor]:
    """Return state entries for ``torch.func.functional_call`` from the vector ``raw`` [..., K]."""
    return {u.key: raw[..., i] for i, u in enumerate(unknowns)}
