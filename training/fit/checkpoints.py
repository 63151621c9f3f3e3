"""Atomic writing and safe reading of checkpoints.

Lightning writes a checkpoint to the system's temporary folder and moves it. Between two file systems this copies over
the only checkpoint, which is lost if the copy is interrupted.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.plugins.io import TorchCheckpointIO
from torch import Tensor

from torchcloth._utils.files import save_tensors
from torchcloth.errors import InvalidInput, TorchclothError
from torchcloth.recordings.checks import MAX_FINITE_VALUE


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """Read a checkpoint, of which only tensors, numbers, text and their containers are accepted.

    Raises:
        InvalidInput: the file is damaged, is no checkpoint of a fit, or holds other objects or infinite numbers.
    """
    try:
        content = torch.load(path, weights_only=True, map_location="cpu")
        is_whole = {"state_dict", "hyper_parameters", "history"} <= content.keys()
    except Exception:  # torch raises anything about a damaged file
        content, is_whole = {}, False
    if is_whole and not _is_finite([content["state_dict"], content["hyper_parameters"]]):
        raise InvalidInput(
            "checkpoint",
            got=f"{path}, with values or a cloth that are not finite",
            expected="finite numbers",
            remedy="start again without --resume",
        )
    if not is_whole:
        raise InvalidInput(
            "checkpoint",
            got=f"{path}, which is damaged, or holds more than tensors, numbers and text",
            expected="what an interrupted run left",
            remedy="start again without --resume",
        )
    return content


@contextmanager
def report_damage(path: str | Path) -> Iterator[None]:
    """Turn any error about the content of a checkpoint into ``InvalidInput``."""
    try:
        yield
    except TorchclothError:
        raise
    except Exception as error:  # a description with other keys or shapes raises anything
        got = f"{path}, which does not describe a cloth ({type(error).__name__}: {error})"
        expected = "a checkpoint of this version of torchcloth"
        raise InvalidInput("checkpoint", got=got, expected=expected, remedy="train again") from error


def _is_finite(node: Any) -> bool:
    """Whether all numbers in nested containers are finite, and their squares too."""
    if isinstance(node, dict):
        return all(map(_is_finite, node.values()))
    if isinstance(node, list | tuple):
        return all(map(_is_finite, node))
    if isinstance(node, Tensor):
        return not node.is_floating_point() or bool((node.double().abs() < MAX_FINITE_VALUE).all())
    return not isinstance(node, float) or abs(node) < MAX_FINITE_VALUE


class AtomicCheckpointIO(TorchCheckpointIO):
    """Checkpoint writer that writes beside the target and then renames.

    Args:
        outdated: results of an earlier run in the folder, removed after the first checkpoint.
    """

    def __init__(self, outdated: Iterable[Path] = ()) -> None:
        self.outdated = list(outdated)

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Save a checkpoint with ``torch.save``; ``storage_options`` are ignored."""
        save_tensors(checkpoint, Path(path))
        for path in self.outdated:
            path.unlink(missing_ok=True)
        self.outdated.clear()
