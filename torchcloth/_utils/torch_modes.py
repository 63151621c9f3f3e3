"""Modes of torch that a caller may be in, and that a computation of the library must not be in."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import torch
import torch.autograd.forward_ad as forward_ad

AUTOCAST_DEVICE_TYPES = ("cpu", "cuda")


@contextmanager
def disable_autocast() -> Iterator[None]:
    """Disable autocast and the default device within the block.

    Eight bits of mantissa are millimetres at one metre. New tensors lie with those that are given, or on the CPU.
    """
    with ExitStack() as stack:
        for device in AUTOCAST_DEVICE_TYPES:
            if torch.is_autocast_enabled(device):
                stack.enter_context(torch.autocast(device, enabled=False))
        if torch.get_default_device().type != "cpu":
            stack.enter_context(torch.device("cpu"))
        yield


@contextmanager
def default_dtype(dtype: torch.dtype) -> Iterator[None]:
    """Set torch's default float type within the block."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


@contextmanager
def isolated_grad_mode() -> Iterator[None]:
    """Enable gradients within the block whatever mode the caller is in, and disable autocast."""
    with torch.inference_mode(False), torch.enable_grad(), disable_autocast():
        yield


def under_torch_transform() -> bool:
    """Return whether tensors carry tangents or batches of a transform, or a mode watches operations on them.

    A backward pass does not count.
    """
    watched = torch._C._are_functorch_transforms_active() or torch._C._len_torch_dispatch_stack() > 0
    return watched or forward_ad._current_level >= 0 or torch.compiler.is_compiling()
