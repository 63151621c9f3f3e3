"""Modes of torch that a caller may be in, and that a computation here must not be in."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import torch

DEVICES = ("cpu", "cuda")


@contextmanager
def full_precision() -> Iterator[None]:
    """Without autocast: eight bits of mantissa are millimetres at a metre's reach."""
    with ExitStack() as stack:
        for device in DEVICES:
            if torch.is_autocast_enabled(device):
                stack.enter_context(torch.autocast(device, enabled=False))
        yield


@contextmanager
def own_gradients() -> Iterator[None]:
    """With gradients, whatever the caller wants of his own tensors, and without autocast."""
    with torch.inference_mode(False), torch.enable_grad(), full_precision():
        yield
