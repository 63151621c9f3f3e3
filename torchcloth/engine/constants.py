"""Constants as numpy arrays, also within torch.func's transforms, which wrap the result of every operation."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor
from torch.overrides import TorchFunctionMode


def is_wrapped(tensor: Tensor) -> bool:
    """Its memory is out of reach."""
    try:
        tensor.data_ptr()
    except RuntimeError:
        return True
    return False


def array(values: ArrayLike | Tensor) -> np.ndarray:
    """The numbers, wrapped or not."""
    if not isinstance(values, Tensor):
        return np.asarray(values)
    values = values.detach().cpu()
    return np.asarray(values.tolist()).reshape(values.shape) if is_wrapped(values) else values.numpy()


class readable(TorchFunctionMode):
    """Context in which ``numpy()`` of a wrapped tensor gives its numbers."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        """Only ``numpy`` is another."""
        if func is torch.Tensor.numpy and is_wrapped(args[0]):
            return np.asarray(args[0].tolist()).reshape(args[0].shape)
        return func(*args, **(kwargs or {}))
