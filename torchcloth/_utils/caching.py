"""Caches: one value per tensor and its version, or the least recently used values by key."""

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
    """One value per tensor, valid while the tensor lives and torch does not write to it."""

    def __init__(self) -> None:
        self._entries: WeakTensorKeyDictionary = WeakTensorKeyDictionary()

    def get_or_compute(self, tensor: Tensor, compute: Callable[[], T], dependencies: object = None) -> T:
        """Return the cached value, or compute it anew if the tensor or ``dependencies`` have changed.

        Tensors of inference mode have no version, so their values are always computed.
        """
        if tensor.is_inference():
            return compute()
        version = tensor._version, dependencies
        entry = self._entries.get(tensor)
        if entry is None or entry[0] != version:
            entry = self._entries[tensor] = version, compute()
        return entry[1]


class LRUCache(Generic[T]):
    """The least recently used values, by key. Callers must not write to a cached value.

    A thread that finds the lock taken computes the value itself: after a fork the thread that holds it may not exist.

    Args:
        max_bytes: bytes that all keys and values may take together.
        size_in_bytes: returns the bytes of a value.
    """

    def __init__(self, max_bytes: int, size_in_bytes: Callable[[T], int]) -> None:
        self.max_bytes, self._size_in_bytes = max_bytes, size_in_bytes
        self._entries: OrderedDict[Hashable, tuple[T, int]] = OrderedDict()
        self._bytes, self._lock = 0, Lock()

    def get_or_compute(self, key: Hashable, compute: Callable[[], T]) -> T:
        """Return the value that was computed for an equal key, or compute and store it."""
        entry = self._if_unlocked(lambda: self._look_up(key))
        if entry is not None:
            return entry[0]
        value = compute()
        self._if_unlocked(lambda: self._store(key, value))
        return value

    def get_by_value(self, tensors: Iterable[Tensor], compute: Callable[[], T]) -> T:
        """Return the value for tensors of equal content, or compute it.

        Where ``value_key`` gives no key, for instance because a tensor carries a gradient, the value is not cached.
        """
        key = value_key(*tensors)
        return compute() if key is None else self.get_or_compute(key, compute)

    def _look_up(self, key: Hashable) -> tuple[T, int] | None:
        entry = self._entries.get(key)
        if entry is not None:
            self._entries.move_to_end(key)
        return entry

    def _store(self, key: Hashable, value: T) -> None:
        parts = key if isinstance(key, tuple) else (key,)
        size = self._size_in_bytes(value) + sum(len(part) for part in parts if isinstance(part, bytes))
        if key in self._entries or size > self.max_bytes:
            return
        self._entries[key] = value, size
        self._bytes += size
        while self._bytes > self.max_bytes:
            self._bytes -= self._entries.popitem(last=False)[1][1]

    def _if_unlocked(self, work: Callable[[], S]) -> S | None:
        if not self._lock.acquire(blocking=False):
            return None
        try:
            return work()
        finally:
            self._lock.release()


def value_key(*tensors: Tensor) -> tuple[Hashable, ...] | None:
    """Return a key made of types, shapes and numbers of the tensors, or None where they are more than numbers.

    None for tensors that carry gradients or tangents, lie on another device or are subclasses. Versions are not enough
    here: the owner of a tensor may write to it through numpy.
    """
    if under_torch_transform() or torch.is_inference_mode_enabled() or not all(map(_is_plain, tensors)):
        return None
    return tuple(
        part for t in tensors for part in (t.dtype, t.shape, t.detach().resolve_neg().contiguous().numpy().tobytes())
    )


def bytes_of(*tensors: Tensor) -> int:
    """Return the bytes that the elements of tensors take together."""
    return sum(t.numel() * t.element_size() for t in tensors)


def _is_plain(tensor: Tensor) -> bool:
    unsupported = tensor.device.type != "cpu" or tensor.layout != torch.strided or tensor.dtype not in CACHEABLE_DTYPES
    if type(tensor) is not Tensor or unsupported or tensor.is_inference():
        return False
    return not (tensor.requires_grad and torch.is_grad_enabled())
