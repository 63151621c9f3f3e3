"""Atomic writing and safe reading of checkpoints.

Lightning writes a checkpoint to the system's temporary folder and moves it. Between two file systems this copies over
the only checkpoint, which is lost if the copy is interrupted.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.plugins.io import TorchCheckpointIO

from torchcloth._utils.files import save_tensors
from torchcloth._utils.resume import DAMAGED_FILE_ERRORS
from torchcloth.errors import InvalidInput


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """Read a checkpoint, of which only tensors, numbers, text and their containers are accepted.

    Raises:
        InvalidInput: the file is damaged, is no checkpoint of a fit, or holds other objects.
    """
    try:
        content = torch.load(path, weights_only=True, map_location="cpu")
        is_whole = {"state_dict", "hyper_parameters", "history"} <= content.keys()
    except (*DAMAGED_FILE_ERRORS, AttributeError):
        content, is_whole = {}, False
    if not is_whole:
        raise InvalidInput(
            "checkpoint",
            got=f"{path}, which is damaged, or holds more than tensors, numbers and text",
            expected="what an interrupted run left",
            remedy="start again without --resume",
        )
    return content


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
