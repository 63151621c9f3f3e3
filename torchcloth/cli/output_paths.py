"""Checks of output paths, done before any work begins."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from .._utils.files import PROGRESS_FOLDER_NAME, check_output_folder
from ..errors import InvalidInput


def output_path(text: str) -> Path:
    """Convert an argument to an output path, for argparse.

    Raises:
        ArgumentTypeError: the text is empty, e.g. because a shell variable is not set.
    """
    if not text.strip():
        raise argparse.ArgumentTypeError(f"got {text!r}; expected a path")
    return Path(text)


def resume_hint(options: argparse.Namespace) -> str:
    """Return what to print after a stop: how to resume, or that nothing was stored."""
    has_progress = (options.out / PROGRESS_FOLDER_NAME).exists()
    return "; `--resume` goes on from there" if has_progress else "; nothing was stored yet"


def print_line(text: str) -> None:
    """Print a line of progress; a reader who closes the pipe does not stop the work."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115 - for the rest of the process


def replacement_note(path: Path) -> str:
    """Return a note for the output if a result exists that will be replaced; call it before writing."""
    return " (the earlier one was replaced)" if path.exists() else ""


def check_outside_episodes(path: Path, *episodes: str | Path, option: str = "--out") -> None:
    """Check that an output path lies outside of the episodes' folders, whose content must not change.

    Raises:
        InvalidInput: the path is an episode's folder or lies inside it.
    """
    inside = path.resolve()
    for episode in episodes:
        folder = Path(episode).resolve()
        if inside == folder or folder in inside.parents:
            raise InvalidInput(option, got=f"{path}, within {episode}, which is read", expected="a place outside it")


def check_output_file(path: Path, option: str = "--out") -> None:
    """Check that a file can be written, without leaving anything behind.

    Raises:
        InvalidInput: the path is a folder, or ``check_output_folder`` refuses its folder.
    """
    if os.path.isdir(path):
        raise InvalidInput(option, got=f"{path}, a folder", expected="a file, new or existing")
    check_output_folder(path.parent, option)
