"""Checkpoints that are there whole or not at all.

Lightning writes one to the system's folder for temporary files and moves it; between two file systems that is a copy
over the only one.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.plugins.io import TorchCheckpointIO

from torchcloth._utils.files import write_atomically


class Whole(TorchCheckpointIO):
    """Written beside its place, then put there.

    Args:
        outdated: results of an earlier run in the folder, which the first checkpoint takes the place of.
    """

    def __init__(self, outdated: Iterable[Path] = ()) -> None:
        self.outdated = list(outdated)

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """As torch.save has it; ``storage_options`` are not used."""
        with write_atomically(Path(path)) as part:
            torch.save(checkpoint, part)
        for path in self.outdated:
            path.unlink(missing_ok=True)
        self.outdated.clear()
