"""Points, directions and other short lists of numbers that a user gives."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ..errors import InvalidInput

HALF_PRECISIONS = ("float16", "bfloat16", "float8")  # how the names of such types begin, in torch and numpy


def parse_unit_vector(what: str, given: Sequence[float]) -> Tensor:
    """Return the given direction as a unit vector [3].

    Raises:
        InvalidInput: not three finite numbers, or all zero.
    """
    vector = parse_vector(what, given)
    length = float(vector.norm())
    if not 0 < length < math.inf:
        raise InvalidInput(what, got=given, expected="three finite numbers, not all zero")
    return vector / length


def parse_vector(what: str, given: Sequence[float]) -> Tensor:
    """Return the given point or vector as a tensor [3].

    Raises:
        InvalidInput: not three finite numbers.
    """
    return parse_finite_numbers(what, given, 3, "three finite numbers")


def parse_finite_numbers(what: str, given: Sequence[float], count: int, expected: str) -> Tensor:
    """Return the given numbers as a tensor [count] of the default precision.

    Args:
        what: name for messages.
        given: the numbers.
        count: how many there must be.
        expected: description of valid numbers, for messages.

    Raises:
        InvalidInput: another count, no numbers, or numbers that are not finite.
    """
    check_has_no_gradient(what, given)
    check_is_not_half(what, given)
    try:
        vector = torch.as_tensor(given, dtype=torch.get_default_dtype())
    except (TypeError, ValueError, RuntimeError) as error:
        raise InvalidInput(what, got=f"{given!r:.40}", expected=expected) from error
    if vector.shape != (count,) or not bool(torch.isfinite(vector).all()):
        raise InvalidInput(what, got=given, expected=expected)
    return vector


def check_is_not_half(what: str, given: object) -> None:
    """Refuse a tensor or an array in half precision, whose rounding is millimetres at one metre.

    Raises:
        InvalidInput: 16 bits or fewer.
    """
    dtype = str(getattr(given, "dtype", "")).removeprefix("torch.")
    if dtype.startswith(HALF_PRECISIONS):
        remedy = "it is rounded by millimetres at one metre already: compute it in float32, outside autocast"
        raise InvalidInput(f"precision of {what}", got=dtype, expected="float32 or float64", remedy=remedy)


def check_has_no_gradient(what: str, given: object) -> None:
    """Refuse a tensor that requires gradients, which would vanish because a part keeps a copy.

    Raises:
        InvalidInput: the tensor requires gradients.
    """
    if isinstance(given, Tensor) and given.requires_grad and torch.is_grad_enabled():
        remedy = "its detach(); what a network gives goes in by torch.func.functional_call, as a parameter of the cloth"
        raise InvalidInput(what, got="a tensor that wants gradients", expected="a value", remedy=remedy)
