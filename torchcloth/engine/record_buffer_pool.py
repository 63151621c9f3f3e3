"""Memory that one gradient after another writes its records to.

The system hands out fresh memory page by page, which costs a gradient as much as a forward run. Here blocks are lent as
tensors, and a block comes back when no tensor holds it any more. No locks: a block may come back in any thread, and
while another one is looked for.
"""

from __future__ import annotations

import weakref

import torch
from torch import Tensor

WORTH = 2**20  # bytes; of less, the allocator keeps its pages itself


class Pool:
    """Blocks that are lent or wait.

    Args:
        most: bytes of both together above which none waits; the oldest goes first.
    """

    def __init__(self, most: int):
        self.most = most
        self._lent, self._waiting = dict[int, int](), dict[int, Tensor]()

    @property
    def waiting(self) -> int:
        """Bytes."""
        return sum(len(block) for block in list(self._waiting.values()))

    def lend(self, *shape: int, dtype: torch.dtype) -> Tensor:
        """A tensor of any content, aligned as torch's own are."""
        size = torch.Size(shape).numel() * dtype.itemsize
        if size < WORTH:
            return torch.empty(shape, dtype=dtype, device="cpu")
        block = self._found(size)
        if block is None:
            self._make_room(size)
            block = torch.empty(size, dtype=torch.uint8, device="cpu")
        self._lent[id(block)] = size
        view = block.numpy()[:]  # which the tensor holds, and nothing else
        weakref.finalize(view, self._back, block).atexit = False
        return torch.from_numpy(view).view(dtype).view(shape)

    def _found(self, size: int) -> Tensor | None:
        for key, block in reversed(list(self._waiting.items())):
            if len(block) == size and self._waiting.pop(key, None) is not None:
                return block
        return None

    def _back(self, block: Tensor) -> None:
        self._lent.pop(id(block), None)
        self._waiting[id(block)] = block
        self._make_room()

    def _make_room(self, size: int = 0) -> None:
        for oldest in list(self._waiting):
            if sum(list(self._lent.values())) + self.waiting + size <= self.most:
                return
            self._waiting.pop(oldest, None)
