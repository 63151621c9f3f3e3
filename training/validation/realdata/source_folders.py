"""Where the measured data lie: $TORCHCLOTH_REALDATA/SOURCE, unless a command line names another folder."""

from __future__ import annotations

import argparse
import os
from pathlib import Path


def source_folder(parser: argparse.ArgumentParser, given: Path | None, name: str) -> Path:
    """The folder of one source; ends the command with a line of help where there is none."""
    if given is None:
        if "TORCHCLOTH_REALDATA" not in os.environ:
            parser.error("name the source's folder with --source, or set TORCHCLOTH_REALDATA")
        given = Path(os.environ["TORCHCLOTH_REALDATA"], name)
    if not given.is_dir():
        parser.error(f"{given} is not a folder")
    return given
