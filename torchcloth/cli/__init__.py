"""The command line ``torchcloth VERB``.

Each verb is one module with a function ``add(verbs)``. Wrong input gives one line on stderr and exit code 2.
"""

from __future__ import annotations

import argparse
import io
import os
import sys
import warnings
from collections.abc import Sequence
from importlib import metadata
from typing import Any, NoReturn

from .._utils.files import DISK_FULL_ERROR_NUMBERS
from ..errors import InvalidInput, TorchclothError, to_message_part
from . import (
    bench,
    confirm,
    convert,
    diagnose,
    doctor,
    export,
    identify,
    inspect,
    new,
    plan,
    pose,
    predict,
    simulate,
    view,
)

VERBS = (
    identify,
    predict,
    pose,
    diagnose,
    confirm,
    plan,
    export,
    inspect,
    view,
    new,
    convert,
    simulate,
    doctor,
    bench,
)
VERBS_WITH_CAUSES = (
    "identify",
    "predict",
    "pose",
    "diagnose",
    "confirm",
    "plan",
    "view",
    "export",
)  # verbs that read model files, which may hold causes of the user's own


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: words after ``torchcloth``; None: those of the process.

    Returns:
        Exit code: 0 done, 2 wrong input, 130 interrupted, 141 if the reader of stdout has closed it.
    """
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed, as by >&-
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 - for the rest of the process
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # the terminal's encoding may lack a character
    try:
        options = _parse_arguments(arguments)
    except KeyboardInterrupt:
        print("torchcloth: stopped", file=sys.stderr)
        return 130
    with warnings.catch_warnings():
        warnings.showwarning = _warn
        return _run(options)


def _run(options: argparse.Namespace) -> int:
    try:
        if getattr(options, "causes", None) is not None:
            from ..diagnosis import register_file

            register_file(options.causes)
        return options.run(options)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes stdout when it exits
        return 141
    except SystemExit as stop:
        if isinstance(stop.__context__, BrokenPipeError):  # rich turns it into exit code 1
            return 141
        raise
    except (TorchclothError, OSError) as error:
        message = error if isinstance(error, TorchclothError) else _from_os_error(error)
        is_full = isinstance(error, OSError) and error.errno in DISK_FULL_ERROR_NUMBERS
        print(f"torchcloth: {message}{_how_to_resume(options) if is_full else ''}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"torchcloth: stopped{_how_to_resume(options)}", file=sys.stderr)
        return 130


def _how_to_resume(options: argparse.Namespace) -> str:
    """Return what the verb says after a stop, or nothing."""
    message = getattr(options, "stopped", "")
    return str(message(options) if callable(message) else message)


def _warn(message: Warning | str, category: type[Warning], *where: Any, **help_text: Any) -> None:
    """Print a warning in one line, without its place in the library's sources."""
    print(f"torchcloth: warning: {to_message_part(str(message))}", file=sys.stderr)


def _from_os_error(error: OSError) -> TorchclothError:
    """Convert an error of the operating system to the library's form."""
    message = error.strerror or str(error)
    if error.filename is None:
        return InvalidInput("the system refuses", got=message)
    if error.errno in DISK_FULL_ERROR_NUMBERS:
        return InvalidInput(f"{error.filename}", got=message, expected="space to write it", remedy="free some space")
    expected = "a path that can be read and written"
    return InvalidInput(
        f"{error.filename}", got=message, expected=expected, remedy="choose another, or change its permissions"
    )


def _parse_arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse the arguments; unknown options are reported under the verb's name, whose help lists the known ones."""
    parser = build_parser()
    options, unknown = parser.parse_known_args(arguments)
    if unknown:
        options.verb.error(f"unrecognized arguments: {' '.join(unknown)}")
    return options


class _Parser(argparse.ArgumentParser):
    """Parser that reports an error in one line, without the usage of all options."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {to_message_part(message)}; to do: see {self.prog} --help\n")


def build_parser() -> argparse.ArgumentParser:
    """Build the parser of the command line, with all verbs; the documentation is generated from it."""
    parser = _Parser(prog="torchcloth", description="Differentiable cloth for robotics.")
    parser.add_argument("--version", action="version", version=metadata.version("torchcloth"))
    verbs = parser.add_subparsers(required=True, metavar="VERB")
    for verb in VERBS:
        verb.add(verbs)
    for name in VERBS_WITH_CAUSES:
        help_text = "Python file that registers your own causes with torchcloth.diagnosis.register"
        verbs.choices[name].add_argument("--causes", metavar="FILE", help=help_text)
    for verb in verbs.choices.values():
        verb.set_defaults(verb=verb)
    return parser
