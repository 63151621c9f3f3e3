"""Folders of the measured data: $TORCHCLOTH_REALDATA/SOURCE, or the one that a command line names."""

from __future__ import annotations

import argparse
import os
from pathlib import Path


def source_folder(parser: argparse.ArgumentParser, folder: Path | None, name: str) -> Path:
    """Return the folder of one source, or end the command with a line of help where there is none.

    Args:
        parser: of the command line.
        folder: that the command line names; None: below TORCHCLOTH_REALDATA.
        name: of the source.
    """
    if folder is None:
        if "TORCHCLOTH_REALDATA" not in os.environ:
            parser.error("name the source's folder with --source, or set TORCHCLOTH_REALDATA")
        folder = Path(os.environ["TORCHCLOTH_REALDATA"], name)
    if not folder.is_dir():
        parser.error(f"{folder} is not a folder")
    return folder
