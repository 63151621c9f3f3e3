"""Physical parameters: learnable, stored unconstrained, always within their domain."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.func import functional_call

from ._utils.vectors import check_has_no_gradient, check_is_not_half
from .errors import InvalidInput

Domain = Literal["positive", "unit_half", "nonnegative", "real"]


class _Interval(NamedTuple):
    lower: float
    upper: float
    includes_lower: bool
    description: str

    @classmethod
    def open_between(cls, lower: float, upper: float) -> _Interval:
        limits = [f"above {lower:g}"] * math.isfinite(lower) + [f"below {upper:g}"] * math.isfinite(upper)
        return cls(lower, upper, False, "a value " + " and ".join(limits))

    def contains(self, value: Tensor) -> bool:
        above = value >= self.lower if self.includes_lower else value > self.lower
        return bool((torch.isfinite(value) & above & (value < self.upper)).all())


_DOMAINS: dict[str, _Interval] = {
    "positive": _Interval(0.0, math.inf, False, "a value > 0"),
    "unit_half": _Interval(0.0, 0.5, False, "a value in (0, 0.5)"),
    "nonnegative": _Interval(0.0, math.inf, True, "a value >= 0"),
    "real": _Interval(-math.inf, math.inf, False, "a finite value"),
}


class PhysicalParameter(nn.Module):
    """One physical quantity with its unit and domain; scalar, or a field with one value per element.

    The stored tensor ``raw`` is unconstrained (log for positive, logit for (0, 0.5)), so every optimiser step stays in
    the domain. Amplitudes of effects are ``nonnegative`` and stored as they are: amplitude 0 must be exactly zero, and
    have a gradient there. After a step of an optimiser ``clip_`` sets negative values to zero (``tc.identify`` does).

    Args:
        value: physical value in ``unit``; a number or a tensor (one value per triangle, or [B, 1] for a batch).
        unit: SI unit, "-" when dimensionless.
        domain: "positive", "unit_half" (Poisson's ratio), "nonnegative" or "real".
        name: name in messages.
        axes: number of trailing axes of its own, after those of a batch.
        bounds: open interval of a "real" parameter. The cloth raises an error after an optimiser step that leaves it.

    Raises:
        InvalidInput: no number or tensor, half precision, outside the domain or not finite.
    """

    def __init__(
        self,
        value: float | Tensor,
        unit: str,
        domain: Domain = "positive",
        *,
        name: str = "parameter",
        axes: int = 1,
        bounds: tuple[float, float] | None = None,
    ) -> None:
        super().__init__()
        if domain not in _DOMAINS:
            raise InvalidInput("domain", got=repr(domain), expected=f"one of {sorted(_DOMAINS)}")
        self.unit, self.label, self.axes = unit, name, axes
        self.domain: Domain = domain
        self._interval = _DOMAINS[domain] if bounds is None else _Interval.open_between(*bounds)
        self.raw = nn.Parameter(self._to_raw(value))

    @property
    def value(self) -> Tensor:
        """Physical value in ``unit``, differentiable with respect to ``raw``."""
        return to_physical(self.raw, self.domain)

    @property
    def field(self) -> Tensor:
        """Physical value in ``unit``, [..., E or 1, 1], to broadcast with fields [..., E, 3] of the triangles."""
        value = self.value
        return value.unsqueeze(-1) if value.ndim else value.reshape(1, 1)

    def set(self, value: float | Tensor) -> None:
        """Assign a physical value in place.

        Raises:
            InvalidInput: a value outside the domain or of another shape; the old value stays.
        """
        check_has_no_gradient(self.label, value)
        with torch.no_grad():
            new = self._to_raw(value, self.raw.dtype).to(self.raw)
            if new.shape != self.raw.shape:
                raise InvalidInput(
                    self.label, got=f"shape {tuple(new.shape)}", expected=f"shape {tuple(self.raw.shape)}"
                )
            self.raw.copy_(new)

    def check_in_domain(self, name: str, remedy: str) -> None:
        """Check that an optimiser step has not left the domain, where values are stored as they are.

        Args:
            name: name of the parameter in the message.
            remedy: what the message advises.

        Raises:
            InvalidInput: a value outside the domain.
        """
        if self.domain in ("nonnegative", "real") and not self._interval.contains(self.raw.detach()):
            raise self._domain_error(name, self.raw.detach(), remedy)

    def _domain_error(self, name: str, tensor: Tensor, remedy: str = "") -> InvalidInput:
        shown = f"{tensor.item():g}" if tensor.numel() == 1 else f"a field in [{tensor.min():g}, {tensor.max():g}]"
        return InvalidInput(name, got=f"{shown} {self.unit}", expected=self._interval.description, remedy=remedy)

    @torch.no_grad()
    def clip_(self) -> None:
        """Set negative values of a nonnegative parameter to zero, in place."""
        if self.domain == "nonnegative":
            self.raw.clamp_(min=0.0)

    def _load_from_state_dict(self, state_dict: Mapping[str, Any], prefix: str, *arguments: Any) -> None:
        """Load ``raw``, and refuse another shape: until 2.9 torch takes a field's first entry for a number."""
        stored, error_messages = state_dict.get(f"{prefix}raw"), arguments[-1]
        if isinstance(stored, Tensor) and stored.shape != self.raw.shape and (self.raw.ndim, stored.shape) != (0, (1,)):
            got, expected = (f"shape {tuple(tensor.shape)}" for tensor in (stored, self.raw))
            remedy = "build the cloth with a field, or a number, as it was when the checkpoint was written"
            error_messages.append(str(InvalidInput(f"{prefix}raw", got=got, expected=expected, remedy=remedy)))
            return
        super()._load_from_state_dict(state_dict, prefix, *arguments)

    def _to_raw(self, value: float | Tensor, dtype: torch.dtype | None = None) -> Tensor:
        check_has_no_gradient(self.label, value)
        check_is_not_half(self.label, value)
        try:
            tensor = torch.as_tensor(value, dtype=None if isinstance(value, Tensor) else torch.float64).detach().clone()
        except (TypeError, ValueError, RuntimeError) as error:
            raise InvalidInput(self.label, got=f"{value!r:.40}", expected="a number or a tensor") from error
        if tensor.is_complex() or not tensor.numel():
            got = "complex numbers" if tensor.is_complex() else f"none, shape {tuple(tensor.shape)}"
            raise InvalidInput(self.label, got=got, expected="real numbers, one at least")
        if not tensor.is_floating_point():
            tensor = tensor.to(torch.get_default_dtype())
        if not self._interval.contains(tensor):
            raise self._domain_error(self.label, tensor)
        if self.domain == "positive":
            tensor = tensor.log()
        elif self.domain == "unit_half":
            tensor = torch.logit(2.0 * tensor)
        return tensor if isinstance(value, Tensor) else tensor.to(dtype or torch.get_default_dtype())

    def extra_repr(self) -> str:
        """Return the line of the data sheet: value and unit."""
        value = self.value.detach()
        shown = f"{value.item():.6g}" if value.numel() == 1 else f"field {tuple(value.shape)}, mean {value.mean():.6g}"
        return f"{shown} {self.unit}"


def require_default_gradients(part: nn.Module) -> None:
    """Set which parameters of a part require gradients: all but facts about the world, ``world_facts`` by name.

    An optimiser over all parameters would else explain misfit by another gravity.
    """
    part.requires_grad_(True)
    for module in part.modules():
        for name in getattr(module, "world_facts", ()):
            getattr(module, name).requires_grad_(False)


def call_with_parameters(module: nn.Module, values: Mapping[str, Tensor], arguments: tuple) -> Any:
    """Return ``module(*arguments)`` with ``values`` in place of the parameters of these names.

    Ties are left alone: torch would replace the parameters of a part that a cloth has twice, and not restore them.
    """
    return functional_call(module, dict(values), arguments, tie_weights=False)


def to_physical(raw: Tensor, domain: Domain) -> Tensor:
    """Map stored numbers to physical values."""
    if domain == "positive":
        return raw.exp()
    if domain == "unit_half":
        return torch.sigmoid(raw) * raw.new_tensor(0.5)  # a Python number would make torch.func.jvp's tangent float64
    return raw
