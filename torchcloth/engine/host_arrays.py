"""Tensors as numpy arrays on the host, also within torch.func's transforms, which wrap every result."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor
from torch.overrides import TorchFunctionMode


def is_wrapped(tensor: Tensor) -> bool:
    """Return whether a transform wraps the tensor, so that its memory is out of reach."""
    try:
        tensor.data_ptr()
    except RuntimeError:
        return True
    return False


def to_numpy(values: ArrayLike | Tensor) -> np.ndarray:
    """Return the numbers as an array, whether a transform wraps them or not."""
    if not isinstance(values, Tensor):
        return np.asarray(values)
    values = values.detach().cpu()
    return np.asarray(values.tolist()).reshape(values.shape) if is_wrapped(values) else values.numpy()


class unwrapped_numpy(TorchFunctionMode):
    """Context in which ``Tensor.numpy`` of a wrapped tensor returns its numbers."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        """Replace ``Tensor.numpy`` of wrapped tensors, and leave every other function as it is."""
        if func is torch.Tensor.numpy and is_wrapped(args[0]):
            return np.asarray(args[0].tolist()).reshape(args[0].shape)
        return func(*args, **(kwargs or {}))
