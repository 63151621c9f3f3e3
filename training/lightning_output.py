"""What Lightning prints that says nothing to the user of a training command."""

from __future__ import annotations

import logging
import warnings

IGNORED_WARNINGS = (
    "does not have many workers",
    "irectory .* exists and is not empty",
    "treespec, LeafSpec",
    "Total length of `list`",
    "overridden `transfer_batch_to_device`",
    "ended before the epoch ended",  # the order of batches begins anew, which changes no result
)


def quieten_lightning() -> None:
    """Ignore Lightning's remarks about workers, folders and its own internals."""
    for message in IGNORED_WARNINGS:
        warnings.filterwarnings("ignore", f".*{message}")
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
