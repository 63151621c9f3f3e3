"""Base class of contracts, and helpers that they share."""

from __future__ import annotations

from abc import ABC
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call

from .._utils.torch_modes import default_dtype


class Contract(ABC):  # noqa: B024 - what is abstract differs between the contracts
    """Promises that a part must keep, as ``test_...`` methods without arguments.

    Inherit it in a class called ``Test...`` and pytest collects it; or call ``check`` from anywhere.
    """

    def check(self) -> None:
        """Run every promise.

        Raises:
            AssertionError: the first promise that is broken.
        """
        for name in dir(self):
            if name.startswith("test_"):
                getattr(self, name)()


def float64() -> AbstractContextManager[None]:
    """Return a context whose default precision is float64, so that parts are float64 from the start."""
    return default_dtype(torch.float64)


class _Caller(nn.Module):
    def __init__(self, part: nn.Module, function: Callable[..., Any]) -> None:
        super().__init__()
        self.part, self.function = part, function

    def forward(self, *args: Any) -> Any:
        return self.function(self.part, *args)


def call_with(part: nn.Module, parameters: dict[str, Tensor], function: Callable[..., Any], *args: Any) -> Any:
    """Return ``function(part, *args)`` with the part's parameters replaced, to give them gradients or batches."""
    named = {f"part.{name}": value for name, value in parameters.items()}
    return functional_call(_Caller(part, function), named, args)


def detached_parameters(part: nn.Module) -> dict[str, Tensor]:
    """Return the part's parameters by name, detached."""
    return {name: value.detach() for name, value in part.named_parameters()}


def batch_parameters(parameters: dict[str, Tensor], size: int, spread: float = 0.1) -> dict[str, Tensor]:
    """Make ``size`` different copies of each parameter in the layout of a batch: [] -> [B, 1], [...] -> [B, ...]."""
    factor = 1 + spread * torch.linspace(-1, 1, size, dtype=torch.float64)
    return {name: factor.reshape(-1, *[1] * max(1, p.ndim)) * p for name, p in parameters.items()}


def unbatch_parameters(parameters: dict[str, Tensor], like: dict[str, Tensor], k: int) -> dict[str, Tensor]:
    """Return copy ``k`` of a batch of parameters, in the shape of the unbatched ones."""
    return {name: value[k].reshape(like[name].shape) for name, value in parameters.items()}


def require_close(got: Tensor, expected: Tensor, tolerance: float, message: str) -> None:
    """Demand |got - expected| <= tolerance x largest |expected|.

    Raises:
        AssertionError: shapes that differ, anything not finite, or a larger difference.
    """
    if got.shape != expected.shape:
        raise AssertionError(f"{message}: shape {tuple(got.shape)}, expected {tuple(expected.shape)}")
    if got.numel() == 0:
        return
    got, expected = got.detach(), expected.detach()
    scale = float(expected.abs().max())
    error = float((got - expected).abs().max())
    if not error <= tolerance * scale:
        raise AssertionError(f"{message}: off by {error:.2e}, allowed {tolerance:.0e} of {scale:.3e}")


def require(condition: bool | Tensor, message: str) -> None:
    """Raise AssertionError with ``message`` unless ``condition``; unlike ``assert``, also under ``python -O``."""
    if not bool(condition):
        raise AssertionError(message)


def require_finite_gradients(result: Tensor, leaves: dict[str, Tensor], where: str) -> None:
    """Demand finite gradients of ``result``'s sum.

    Raises:
        AssertionError: naming the leaf.
    """
    gradients = torch.autograd.grad(result.sum(), list(leaves.values()), retain_graph=True, allow_unused=True)
    for name, gradient in zip(leaves, gradients, strict=True):
        require(gradient is None or torch.isfinite(gradient).all(), f"the gradient in {name!r} is not finite {where}")
