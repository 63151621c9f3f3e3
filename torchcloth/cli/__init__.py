"""The command line: one module a verb. Wrong input: one line on stderr, exit code 2."""

from __future__ import annotations

import argparse
import io
import os
import sys
import warnings
from collections.abc import Sequence
from importlib import metadata
from typing import Any, NoReturn

from ..errors import InvalidInput, TorchclothError
from . import bench, confirm, convert, diagnose, doctor, identify, inspect, plan, pose, predict, simulate, view

VERBS = (
    identify,
    predict,
    pose,
    diagnose,
    confirm,
    plan,
    inspect,
    view,
    convert,
    simulate,
    doctor,
    bench,
)  # each has add(verbs)
WITH_MODELS = (
    "identify",
    "predict",
    "pose",
    "diagnose",
    "confirm",
    "plan",
    "view",
)  # which a user's own causes may be in


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code (0 done, 2 wrong input, 130 interrupted, 141 where nobody reads on)."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a terminal that has no such letter
    try:
        options = _parsed(arguments)
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
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python writes what is left at its end
        return 141
    except (TorchclothError, OSError) as error:
        said = error if isinstance(error, TorchclothError) else _of_system(error)
        print(f"torchcloth: {said}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        said = getattr(options, "stopped", "")
        print(f"torchcloth: stopped{said(options) if callable(said) else said}", file=sys.stderr)
        return 130


def _warn(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
    """One line, without the place in the library's sources."""
    print(f"torchcloth: warning: {message}", file=sys.stderr)


def _of_system(error: OSError) -> TorchclothError:
    """What the system says of a file, as everything else is said."""
    said = error.strerror or str(error)
    if error.filename is None:
        return InvalidInput("the system refuses", got=said)
    expected = "a path that can be read and written"
    return InvalidInput(
        f"{error.filename}", got=said, expected=expected, remedy="choose another, or change its permissions"
    )


def _parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    """What is not known is the verb's matter, which has options of its own."""
    parser = _parser()
    options, unknown = parser.parse_known_args(arguments)
    if unknown:
        options.verb.error(f"unrecognized arguments: {' '.join(unknown)}")
    return options


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line, without the usage of all options."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}; to do: see {self.prog} --help\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="torchcloth", description="Differentiable cloth for robotics.")
    parser.add_argument("--version", action="version", version=metadata.version("torchcloth"))
    verbs = parser.add_subparsers(required=True, metavar="VERB")
    for verb in VERBS:
        verb.add(verbs)
    for name in WITH_MODELS:
        more = "a Python file that registers causes of your own (torchcloth.diagnosis.register)"
        verbs.choices[name].add_argument("--causes", metavar="FILE", help=more)
    for verb in verbs.choices.values():
        verb.set_defaults(verb=verb)
    return parser
