"""Finite differences as a sweep over steps: one step alone proves nothing, the fall of the error with h^2 does."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ..errors import InvalidInput

DIFFERENCE_STEPS = tuple(10.0 ** (-1 - k / 2) for k in range(10))
_ROUNDING_STEPS = (1e-9, 3e-10)  # at these steps a second difference is rounding alone
_DERIVATIVE_ROUNDING = 1e-12  # relative, of a derivative that was itself computed in float64


@dataclass(frozen=True)
class Sweep:
    """Central differences of a function over falling steps, and the derivative that is claimed.

    Attributes:
        steps: [N] falling, in units of the direction.
        estimates: [N] central differences.
        derivative: the claimed derivative.
        noise: measured rounding of one difference of function values.
    """

    steps: Tensor
    estimates: Tensor
    derivative: float
    noise: float

    @property
    def scale(self) -> float:
        """Scale of relative errors: the derivative, or the median estimate where that is larger."""
        return max(abs(self.derivative), float(self.estimates.abs().median())) or 1.0

    @property
    def errors(self) -> Tensor:
        """Relative errors of the estimates, [N]."""
        return (self.estimates - self.derivative).abs() / self.scale

    @property
    def floor(self) -> Tensor:
        """Relative errors that rounding explains, [N]."""
        return self.noise / (self.steps * self.scale) + _DERIVATIVE_ROUNDING

    def check(self, tolerance: float = 1e-7, slack: float = 0.2) -> float:
        """Accept the derivative, or raise an error that says why not.

        The error must fall with slope 2 +- ``slack`` wherever it is neither rounding (ten times the floor) nor settled
        (a hundredth of the tolerance). It must reach ``tolerance`` where rounding would not hide more than that. Coarse
        steps before a wrong slope do not count (higher orders, a kink within reach), so a wrong derivative leaves no
        step that counts. Errors that are rounding from the start are accepted: parabolas have no others.

        Returns:
            The smallest relative error.

        Raises:
            AssertionError: with the table of steps, errors and slopes.
        """
        if not bool(torch.isfinite(self.estimates).all()) or not math.isfinite(self.derivative):
            raise AssertionError(f"not finite\n{self}")
        errors, floor = self.errors, self.floor
        visible = errors > torch.clamp(10 * floor, min=tolerance / 100)
        pairs = (visible[1:] & visible[:-1]).nonzero().flatten().tolist()
        start = max((k + 1 for k in pairs if abs(self._slope(k) - 2) > slack), default=0)
        counts = errors[start:][floor[start:] <= tolerance]
        if len(counts) < 3:
            raise AssertionError(f"the error does not fall with the square of the step\n{self}")
        best = float(counts.min())
        if not best <= tolerance:
            raise AssertionError(f"the error never falls to {tolerance:.1e}; best {best:.1e}\n{self}")
        return best

    def _slope(self, k: int) -> float:
        ratio = self.errors[k] / self.errors[k + 1]
        return float(ratio.log() / (self.steps[k] / self.steps[k + 1]).log())

    def __str__(self) -> str:
        rows = [f"claimed derivative {self.derivative:.9e}", "    step   estimate          error    rounding  slope"]
        for k, (step, estimate, error, floor) in enumerate(
            zip(self.steps.tolist(), self.estimates.tolist(), self.errors.tolist(), self.floor.tolist(), strict=True)
        ):
            slope = f"{self._slope(k):5.2f}" if k + 1 < len(self.steps) else ""
            rows.append(f"{step:9.1e}  {estimate:+.9e}  {error:.1e}  {floor:.1e}  {slope}")
        return "\n".join(rows)


def finite_difference_sweep(
    function: Callable[[Tensor], Tensor],
    point: Tensor,
    direction: Tensor,
    derivative: float | Tensor,
    steps: Sequence[float] = DIFFERENCE_STEPS,
) -> Sweep:
    """Compute central differences of ``function`` at ``point`` along ``direction``, to compare with ``derivative``.

    Args:
        function: point -> scalar, in float64.
        point: [...] float64.
        direction: [...] like ``point``, with the size of a coarse change.
        derivative: the claimed directional derivative d function(point + h direction) / dh at h = 0.
        steps: values of h.

    Raises:
        InvalidInput: not float64, or a function that is not scalar.
    """
    if point.dtype != torch.float64:
        raise InvalidInput("point", got=point.dtype, expected="torch.float64", remedy="rounding hides h^2 otherwise")
    point, direction = point.detach(), direction.detach()
    ordered = sorted(steps, reverse=True)

    def value(h: float) -> float:
        with torch.no_grad():
            out = function(point + h * direction)
        if out.numel() != 1:
            raise InvalidInput("function", got=f"a result of shape {tuple(out.shape)}", expected="a scalar")
        return float(out)

    centre = value(0.0)
    seconds = [abs(value(h) - 2 * centre + value(-h)) for h in _ROUNDING_STEPS]
    noise = max(*seconds, torch.finfo(torch.float64).eps * abs(centre))
    estimates = [(value(h) - value(-h)) / (2 * h) for h in ordered]
    steps64, estimates64 = (torch.tensor(values, dtype=torch.float64) for values in (ordered, estimates))
    return Sweep(steps64, estimates64, float(derivative), noise)


def check_gradients(
    function: Callable[..., Tensor],
    inputs: Mapping[str, Tensor],
    tolerance: float = 1e-7,
    steps: Sequence[float] = DIFFERENCE_STEPS,
    seed: int = 0,
    sizes: Mapping[str, float] | None = None,
    acts: bool = False,
) -> dict[str, float]:
    """Check a function's reverse-mode gradient in each input by a sweep along a random direction of the input's size.

    Args:
        function: called with ``inputs`` by keyword; a result that is not scalar is weighted at random and summed.
        inputs: float64 tensors by name.
        tolerance: relative.
        steps: of the sweep.
        seed: of directions and weights.
        sizes: of a coarse change of an input, where its own mean size is not it (logarithms).
        acts: raise an error also for an input that does not change the result, which a sweep cannot test.

    Returns:
        The smallest relative error of each input.

    Raises:
        AssertionError: naming the input whose gradient is wrong.
    """
    random = torch.Generator().manual_seed(seed)
    leaves = {name: value.detach().clone().requires_grad_() for name, value in inputs.items()}
    result = function(**leaves)
    weight = torch.randn(result.shape, generator=random, dtype=torch.float64)
    gradients = torch.autograd.grad((weight * result).sum(), list(leaves.values()), allow_unused=True)
    best = {}
    for (name, value), gradient in zip(inputs.items(), gradients, strict=True):
        size = (sizes or {}).get(name) or float(value.detach().abs().mean()) or 1.0
        direction = size * torch.randn(value.shape, generator=random, dtype=torch.float64)
        claim = 0.0 if gradient is None else float((gradient * direction).sum())

        def along(moved: Tensor, name: str = name) -> Tensor:
            return (weight * function(**{**inputs, name: moved})).sum()

        try:
            sweep = finite_difference_sweep(along, value, direction, claim, steps)
            best[name] = sweep.check(tolerance)
            if acts and abs(claim) * float(sweep.steps.max()) <= 10 * sweep.noise:
                raise AssertionError(f"it does not move the result\n{sweep}")
        except AssertionError as error:
            raise AssertionError(f"gradient in {name!r}: {error}") from None
    return best
