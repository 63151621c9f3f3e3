"""Modes of torch that a caller may be in, and that a computation here must not be in."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import torch
import torch.autograd.forward_ad as forward_ad

AUTOCAST_DEVICE_TYPES = ("cpu", "cuda")


@contextmanager
def disable_autocast() -> Iterator[None]:
    """Without autocast, whose eight bits of mantissa are millimetres at a metre's reach, and without a default device.

    What is made on the way is made beside the tensors that are given, or on the CPU.
    """
    with ExitStack() as stack:
        for device in AUTOCAST_DEVICE_TYPES:
            if torch.is_autocast_enabled(device):
                stack.enter_context(torch.autocast(device, enabled=False))
        if torch.get_default_device().type != "cpu":
            stack.enter_context(torch.device("cpu"))
        yield


@contextmanager
def isolated_grad_mode() -> Iterator[None]:
    """With gradients, whatever the caller wants of his own tensors, and disable_autocast."""
    with torch.inference_mode(False), torch.enable_grad(), disable_autocast():
        yield


def under_torch_transform() -> bool:
    """Whether something goes along with numbers, or looks at what is done to them, other than a backward pass."""
    watched = torch._C._are_functorch_transforms_active() or torch._C._len_torch_dispatch_stack() > 0
    return watched or forward_ad._current_level >= 0 or torch.compiler.is_compiling()
