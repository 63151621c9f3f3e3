"""What was found last: for a tensor, or for what it depends on."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable
from threading import Lock
from typing import Generic, TypeVar

import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from .torch_modes import under_torch_transform

CACHEABLE_DTYPES = (torch.float64, torch.float32, torch.bool)
T = TypeVar("T")
S = TypeVar("S")


class VersionedTensorCache(Generic[T]):
    """One value per tensor, for as long as the tensor is there and torch does not write to it."""

    def __init__(self) -> None:
        self._last: WeakTensorKeyDictionary = WeakTensorKeyDictionary()

    def get_or_compute(self, tensor: Tensor, compute: Callable[[], T], dependencies: object = None) -> T:
        """``find()``, or what it said last, where neither the tensor nor ``beside`` is another one since."""
        if tensor.is_inference():  # nothing tells whether somebody wrote to it
            return compute()
        now = tensor._version, dependencies
        kept = self._last.get(tensor)
        if kept is None or kept[0] != now:
            kept = self._last[tensor] = now, compute()
        return kept[1]


class LRUCache(Generic[T]):
    """The values that were asked for last, by what they depend on; nobody may write to one.

    Nobody waits for another thread either, which may not be there any more after a fork.

    Args:
        budget: bytes that they may take together.
        size: bytes of a value.
    """

    def __init__(self, max_bytes: int, size_in_bytes: Callable[[T], int]) -> None:
        self.max_bytes, self._size = max_bytes, size_in_bytes
        self._kept: OrderedDict[Hashable, tuple[T, int]] = OrderedDict()
        self._bytes, self._lock = 0, Lock()

    def get_or_compute(self, key: Hashable, compute: Callable[[], T]) -> T:
        """``find()``, or what it said for an equal key."""
        known = self._alone(lambda: self._known(key))
        if known is not None:
            return known[0]
        value = compute()
        self._alone(lambda: self._keep(key, value))
        return value

    def get_by_value(self, tensors: Iterable[Tensor], compute: Callable[[], T]) -> T:
        """The same by what tensors say; where more than numbers goes along with them, it is found anew."""
        key = value_key(*tensors)
        return compute() if key is None else self.get_or_compute(key, compute)

    def _known(self, key: Hashable) -> tuple[T, int] | None:
        found = self._kept.get(key)
        if found is not None:
            self._kept.move_to_end(key)
        return found

    def _keep(self, key: Hashable, value: T) -> None:
        parts = key if isinstance(key, tuple) else (key,)
        size = self._size(value) + sum(len(part) for part in parts if isinstance(part, bytes))
        if key in self._kept or size > self.max_bytes:
            return
        self._kept[key] = value, size
        self._bytes += size
        while self._bytes > self.max_bytes:
            self._bytes -= self._kept.popitem(last=False)[1][1]

    def _alone(self, work: Callable[[], S]) -> S | None:
        if not self._lock.acquire(blocking=False):
            return None
        try:
            return work()
        finally:
            self._lock.release()


def value_key(*tensors: Tensor) -> tuple[Hashable, ...] | None:
    """What tensors say, by which it can be told from anything else; None where more than numbers goes along with them.

    Their owner may write to them at any time, by numpy unseen.
    """
    if under_torch_transform() or torch.is_inference_mode_enabled() or not all(map(_is_plain, tensors)):
        return None
    return tuple(
        part for t in tensors for part in (t.dtype, t.shape, t.detach().resolve_neg().contiguous().numpy().tobytes())
    )


def bytes_of(*tensors: Tensor) -> int:
    """Bytes."""
    return sum(t.numel() * t.element_size() for t in tensors)


def _is_plain(tensor: Tensor) -> bool:
    elsewhere = tensor.device.type != "cpu" or tensor.layout != torch.strided or tensor.dtype not in CACHEABLE_DTYPES
    if type(tensor) is not Tensor or elsewhere or tensor.is_inference():
        return False
    return not (tensor.requires_grad and torch.is_grad_enabled())
