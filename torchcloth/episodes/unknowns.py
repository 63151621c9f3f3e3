"""What a fit may change: parameters by public name, as one unconstrained vector with a prior."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..cloth import Cloth
from ..errors import InvalidInput
from ..parameters import PhysicalParameter, to_value

DECADE = math.log(10.0)
TOLD = 0.5  # of a prior's width, below which the data have told something
TRUSTED = 0.25  # a parameter counts as identified when its standard error is below a quarter of its value
ABSENT = {  # effects that an episode's facts bring into the model
    "air": "the model has no air: give air.density in episode.json",
    "bending": "the model has no bending: give cloth.nominal.bending_stiffness in episode.json",
}
TYPICAL = {"friction": 0.3, "excess": 0.1, "cone": 0.3}  # amplitudes of parts that are no effects, by their own name
PRIOR_LOGIT = 1.0  # of logit(2 nu): around 0.2, 95 % of the prior between 0.04 and 0.42


@dataclass(frozen=True, eq=False)
class Unknown:
    """One scalar parameter of the fit.

    Attributes:
        name: public name, e.g. "youngs_modulus" or "air.normal".
        key: name of the stored tensor in the cloth's state.
        parameter: the parameter at its start value.
        start: unconstrained start value.
        prior_std: standard deviation of the prior, in the unconstrained coordinate.
        typical: size of an amplitude, which may be zero, in its unit; 0 of any other parameter.
        mean: the prior's middle; None: the start.
        measured: known before the fit: a weighed areal density, or by a given prior that is narrower than ``TRUSTED``.
    """

    name: str
    key: str
    parameter: PhysicalParameter
    start: float
    prior_std: float
    typical: float = 0.0
    measured: bool = False
    mean: float | None = None

    @property
    def middle(self) -> float:
        """Of the prior, unconstrained."""
        return self.start if self.mean is None else self.mean

    @property
    def longest_step(self) -> float:
        """Of one iteration: a factor of 2.7 on a log parameter, half the typical size of an amplitude."""
        return 0.5 * self.typical or 1.0

    @property
    def size(self) -> float:
        """Of a change that matters: a factor of e of a log parameter, the typical size of an amplitude."""
        return self.typical or 1.0

    def value(self, raw: float) -> float:
        """Physical value of an unconstrained one."""
        return float(to_value(torch.tensor(raw, dtype=torch.float64), self.parameter.domain))

    def slope(self, raw: float) -> float:
        """d value / d raw."""
        x = torch.tensor(raw, dtype=torch.float64, requires_grad=True)
        return float(torch.autograd.grad(to_value(x, self.parameter.domain), x)[0])

    def clip(self, raw: float) -> float:
        """The nearest legal unconstrained value (amplitudes are stored as they are)."""
        return max(raw, 0.0) if self.parameter.domain == "nonnegative" else raw


def available(cloth: Cloth) -> dict[str, str]:
    """Public name -> module path of every scalar physical parameter of a cloth."""
    found = {}
    for path, module in cloth.named_modules():
        if isinstance(module, PhysicalParameter) and module.raw.ndim == 0:
            head, _, tail = path.partition(".")
            found[tail if head in ("material", "effects", "boundaries") else path] = path
    return found


def needs_contact(cloth: Cloth, path: str) -> bool:
    """Parameters of the director law do nothing in a model without contact."""
    return cloth.contact is None and path in ("material.contact_stiffness", "material.shear_stiffness", "material.cone")


def collect(
    cloth: Cloth, names: Sequence[str], weighed: tuple[float, float] | None, absent: bool = False
) -> list[Unknown]:
    """The unknowns of a fit, by public name; areal density joins as it was ``weighed`` (value, standard deviation),
    wherever the cloth's own starts.

    ``absent`` admits parameters that the model does not contain, for reports.

    Raises:
        InvalidInput: an unknown name or a field-valued parameter.
    """
    known = available(cloth)
    out = []
    for name in dict.fromkeys(names):
        if name not in known:
            possible = sorted(n for n, path in known.items() if not needs_contact(cloth, path))
            part = dict(cloth.material.named_modules()).get(name)
            field = isinstance(part, PhysicalParameter)
            remedy = "a value for each triangle: fit_fields" if field else ABSENT.get(name.split(".")[0], "")
            raise InvalidInput(
                "parameter to fit", got=repr(name), expected=f"one of {', '.join(possible)}", remedy=remedy
            )
        if needs_contact(cloth, known[name]) and not absent:
            raise InvalidInput(
                "parameter to fit",
                got=repr(name),
                expected="a parameter of the model",
                remedy="it needs contact between layers (--contact; in a config model.contact)",
            )
        out.append(_unknown(cloth, name, known[name]))
    if weighed and "areal_density" in known and "areal_density" not in names:
        start, (value, std), key = float(cloth.areal_density.raw.detach()), weighed, known["areal_density"] + ".raw"
        mean = math.log(value)
        out.append(Unknown("areal_density", key, cloth.areal_density, start, std / value, measured=True, mean=mean))
    return out


def _unknown(cloth: Cloth, name: str, path: str) -> Unknown:
    parameter = cloth.get_submodule(path)
    if not isinstance(parameter, PhysicalParameter):
        raise InvalidInput("parameter to fit", got=repr(name), expected="a scalar physical parameter")
    start = float(parameter.raw.detach())
    typical = 0.0
    if parameter.domain == "positive":
        std = DECADE
    elif parameter.domain == "unit_half":
        std = PRIOR_LOGIT
    else:
        owner, _, own = path.rpartition(".")
        size = getattr(cloth.get_submodule(owner), "amplitudes", {}).get(own)
        # undeclared: the start says how large it is
        typical = TYPICAL.get(own, max(1.0, abs(start))) if size is None else size.typical
        std = 2.0 * typical
    return Unknown(name, f"{path}.raw", parameter, start, std, typical)


def with_priors(unknowns: Sequence[Unknown], priors: Mapping[str, tuple[float, float]]) -> list[Unknown]:
    """Priors (value, factor) of positive parameters and (value, standard deviation) of others, by name.

    Raises:
        InvalidInput: a name that is not fitted, or numbers that make no prior.
    """
    names = [u.name for u in unknowns]
    for name, pair in priors.items():
        if name not in names:
            raise InvalidInput("priors", got=repr(name), expected=f"some of {', '.join(names)}")
        positive = unknowns[names.index(name)].parameter.domain == "positive"
        two = isinstance(pair, Sequence) and len(pair) == 2
        if not two or not (math.isfinite(pair[1]) and pair[1] > (1.0 if positive else 0.0)):
            expected = "(value, factor > 1)" if positive else "(value, standard deviation > 0)"
            raise InvalidInput(f"prior of {name}", got=pair, expected=expected)
    return [_around(u, *priors[u.name]) if u.name in priors else u for u in unknowns]


def _around(unknown: Unknown, value: float, spread: float) -> Unknown:
    p = unknown.parameter
    mean = float(PhysicalParameter(value, p.unit, p.domain, name=f"prior of {unknown.name}").raw.detach())
    std = math.log(spread) if p.domain == "positive" else spread / unknown.slope(mean)
    known = unknown.slope(mean) * std < TRUSTED * max(abs(value), unknown.typical)
    return replace(unknown, mean=mean, prior_std=std, measured=unknown.measured or known)


def overrides(unknowns: Sequence[Unknown], raw: Tensor) -> dict[str, Tensor]:
    """State entries for ``torch.func.functional_call`` from the vector ``raw`` [..., K]."""
    return {u.key: raw[..., i] for i, u in enumerate(unknowns)}
