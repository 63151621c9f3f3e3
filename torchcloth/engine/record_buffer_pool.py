"""Memory that one gradient after another writes its records to.

The system hands out fresh memory page by page, which costs a gradient as much as a forward run. Here blocks are lent as
tensors, and a block returns when no tensor refers to it any more. There are no locks: a block may return in any thread,
and while another one is searched for.
"""

from __future__ import annotations

import weakref

import torch
from torch import Tensor

MIN_POOLED_BYTES = 2**20  # the allocator keeps the pages of smaller blocks itself


class RecordBufferPool:
    """Blocks of memory that are in use or wait for the next use.

    Args:
        max_bytes: size of all blocks together above which none waits; the oldest one is freed first.
    """

    def __init__(self, max_bytes: int):
        self.max_bytes = max_bytes
        self._in_use, self._pending = dict[int, int](), dict[int, Tensor]()

    @property
    def pending_bytes(self) -> int:
        """Size of the blocks that wait [bytes]."""
        return sum(len(block) for block in list(self._pending.values()))

    def acquire(self, *shape: int, dtype: torch.dtype) -> Tensor:
        """Return a tensor on the CPU of any content, aligned as torch's own are."""
        size = torch.Size(shape).numel() * dtype.itemsize
        if size < MIN_POOLED_BYTES:
            return torch.empty(shape, dtype=dtype, device="cpu")
        block = self._take_pending(size)
        if block is None:
            self._evict(size)
            block = torch.empty(size, dtype=torch.uint8, device="cpu")
        self._in_use[id(block)] = size
        view = block.numpy()[:]  # only the tensor refers to this view
        weakref.finalize(view, self._release, block).atexit = False
        return torch.from_numpy(view).view(dtype).view(shape)

    def _take_pending(self, size: int) -> Tensor | None:
        for key, block in reversed(list(self._pending.items())):
            if len(block) == size and self._pending.pop(key, None) is not None:
                return block
        return None

    def _release(self, block: Tensor) -> None:
        self._in_use.pop(id(block), None)
        self._pending[id(block)] = block
        self._evict()

    def _evict(self, size: int = 0) -> None:
        """Free waiting blocks until ``size`` more bytes fit."""
        for oldest in list(self._pending):
            if sum(list(self._in_use.values())) + self.pending_bytes + size <= self.max_bytes:
                return
            self._pending.pop(oldest, None)
