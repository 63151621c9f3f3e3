"""Errors whose text says what is wrong, what was got, what was expected, and what to do."""

from __future__ import annotations

import re

MAX_PART_CHARACTERS = 1000  # of each part of a message; the middle of a longer one is left out
# C0, DEL and C1, which steer a terminal, and the marks that reverse the direction of text.
_CONTROL_CHARACTERS = re.compile("[\x00-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")


def has_control_characters(text: str) -> bool:
    """Return whether a text could steer a terminal or hide what it says."""
    return _CONTROL_CHARACTERS.search(text) is not None


def escape_control_characters(text: str) -> str:
    """Return the text with ``\\x1b`` and the like in place of characters that could steer a terminal."""
    return _CONTROL_CHARACTERS.sub(lambda match: match[0].encode("unicode_escape").decode(), text)


def to_message_part(text: str) -> str:
    """Return a text as one line of at most 1000 characters, without characters that could steer a terminal."""
    line = escape_control_characters(" ".join(text.split()))
    if len(line) <= MAX_PART_CHARACTERS:
        return line
    end = MAX_PART_CHARACTERS // 3
    return f"{line[: MAX_PART_CHARACTERS - end]} ... {line[-end:]}"


class TorchclothError(ValueError):
    """Base of every error that torchcloth raises on purpose; its text is one line of bounded length.

    Args:
        what: name of the wrong argument, as the caller knows it.
        got: the offending value or a short description of it.
        expected: what would have been accepted.
        remedy: what to do about it.
    """

    def __init__(self, what: str, *, got: object = None, expected: str = "", remedy: str = "") -> None:
        self.what, self.got, self.expected, self.remedy = what, got, expected, remedy
        parts = [what]
        if got is not None:
            parts.append(f"got {got}")
        if expected:
            parts.append(f"expected {expected}")
        if remedy:
            parts.append(remedy)
        super().__init__("; ".join(map(to_message_part, parts)))

    def __reduce__(self) -> tuple:
        return _rebuild, (type(self), self.what, self.got, self.expected, self.remedy)


def _rebuild(cls: type[TorchclothError], what: str, got: object, expected: str, remedy: str) -> TorchclothError:
    return cls(what, got=got, expected=expected, remedy=remedy)


class InvalidInput(TorchclothError):
    """An argument that is not valid."""


class RecordingError(TorchclothError):
    """An episode on disk that cannot be trusted."""


class UnstableStep(TorchclothError):
    """A time step beyond the stability limit of the explicit integration."""


class SimulationDiverged(TorchclothError):
    """A state that is no longer finite; the text names the step and the first vertex."""


class MissingDependency(TorchclothError, ImportError):
    """An optional package that is not installed but needed."""
