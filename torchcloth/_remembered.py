"""What was found last for a tensor."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

T = TypeVar("T")


class Remembered(Generic[T]):
    """One value per tensor, for as long as the tensor is there and torch does not write to it."""

    def __init__(self) -> None:
        self._last: WeakTensorKeyDictionary = WeakTensorKeyDictionary()

    def of(self, tensor: Tensor, find: Callable[[], T], beside: object = None) -> T:
        """``find()``, or what it said last, where neither the tensor nor ``beside`` is another one since."""
        if tensor.is_inference():  # nothing tells whether somebody wrote to it
            return find()
        now = tensor._version, beside
        kept = self._last.get(tensor)
        if kept is None or kept[0] != now:
            kept = self._last[tensor] = now, find()
        return kept[1]
