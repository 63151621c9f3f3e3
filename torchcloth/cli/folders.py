"""Places to write to, tried before any work is done."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from .._utils.files import PROGRESS, check_folder
from ..errors import InvalidInput


def place(text: str) -> Path:
    """A path to write to, as argparse wants it: an empty one, of a variable that is not set, is none."""
    if not text.strip():
        raise argparse.ArgumentTypeError(f"got {text!r}; expected a path")
    return Path(text)


def how_to_go_on(options: argparse.Namespace) -> str:
    """Of a command that was stopped and keeps what it has done."""
    kept = (options.out / PROGRESS).exists()
    return "; `--resume` goes on from there" if kept else "; nothing was kept yet"


def say(text: str) -> None:
    """A line of progress; who does not want to read on stops no work."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115 - for the rest of the process


def replaces(path: Path) -> str:
    """What to say beside a result's name, asked before it is written."""
    return " (the last one is replaced)" if path.exists() else ""


def check_apart(path: Path, *episodes: str | Path, option: str = "--out") -> None:
    """Refuse a place within one of the episodes' folders, whose files would be replaced or taken for its own.

    Raises:
        InvalidInput: it is one.
    """
    inside = path.resolve()
    for episode in episodes:
        folder = Path(episode).resolve()
        if inside == folder or folder in inside.parents:
            raise InvalidInput(option, got=f"{path}, within {episode}, which is read", expected="a place outside it")


def check_file(path: Path, option: str = "--out") -> None:
    """Refuse, before any work is done, a file that cannot be written; leaves nothing behind.

    Raises:
        InvalidInput: it is a folder, or ``check_folder`` refuses its folder.
    """
    if os.path.isdir(path):
        raise InvalidInput(option, got=f"{path}, a folder", expected="a file, new or existing")
    check_folder(path.parent, option)
