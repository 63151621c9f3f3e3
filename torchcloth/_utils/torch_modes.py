"""Modes of torch that a caller may be in, and that a computation here must not be in."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import torch
import torch.autograd.forward_ad as forward_ad

DEVICES = ("cpu", "cuda")


@contextmanager
def undisturbed() -> Iterator[None]:
    """Without autocast, whose eight bits of mantissa are millimetres at a metre's reach, and without a default device.

    What is made on the way is made beside the tensors that are given, or on the CPU.
    """
    with ExitStack() as stack:
        for device in DEVICES:
            if torch.is_autocast_enabled(device):
                stack.enter_context(torch.autocast(device, enabled=False))
        if torch.get_default_device().type != "cpu":
            stack.enter_context(torch.device("cpu"))
        yield


@contextmanager
def own_gradients() -> Iterator[None]:
    """With gradients, whatever the caller wants of his own tensors, and undisturbed."""
    with torch.inference_mode(False), torch.enable_grad(), undisturbed():
        yield


def transformed() -> bool:
    """Whether something goes along with numbers, or looks at what is done to them, other than a backward pass."""
    watched = torch._C._are_functorch_transforms_active() or torch._C._len_torch_dispatch_stack() > 0
    return watched or forward_ad._current_level >= 0 or torch.compiler.is_compiling()
