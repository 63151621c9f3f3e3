"""Atomic writing of checkpoints.

Lightning writes a checkpoint to the system's temporary folder and moves it. Between two file systems this copies over
the only checkpoint, which is lost if the copy is interrupted.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.plugins.io import TorchCheckpointIO

from torchcloth._utils.files import write_atomically


class AtomicCheckpointIO(TorchCheckpointIO):
    """Checkpoint writer that writes beside the target and then renames.

    Args:
        outdated: results of an earlier run in the folder, removed after the first checkpoint.
    """

    def __init__(self, outdated: Iterable[Path] = ()) -> None:
        self.outdated = list(outdated)

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Save a checkpoint with ``torch.save``; ``storage_options`` are ignored."""
        with write_atomically(Path(path)) as part:
            torch.save(checkpoint, part)
        for path in self.outdated:
            path.unlink(missing_ok=True)
        self.outdated.clear()
