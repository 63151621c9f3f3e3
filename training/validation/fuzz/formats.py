"""The registry of fuzzed formats, and the judgement of one input."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from random import Random

from torchcloth.errors import MAX_PART_CHARACTERS, MissingDependency, TorchclothError, has_control_characters

from .invariants import require

MAX_MESSAGE_CHARACTERS = 4 * (MAX_PART_CHARACTERS + len("; expected "))  # what, got, expected and remedy

ByteMutation = Callable[[bytes, int], bytes]  # changed bytes of at most so many
Mutation = Callable[[Random, bytes, int, ByteMutation], bytes]


@dataclass(frozen=True)
class FuzzedFormat:
    """One format that strangers' files have.

    Attributes:
        name: of the format.
        read: reads the bytes of a file, and checks that what it accepts satisfies the invariants of the format.
        mutate: changes the content of a file, so that checksums and structure do not refuse every change.
        instrumented: prefixes of the modules whose branches guide the search.
    """

    name: str
    read: Callable[[bytes], None]
    mutate: Mutation
    instrumented: tuple[str, ...]


FORMATS: dict[str, FuzzedFormat] = {}


def register_format(
    name: str, mutate: Mutation, *instrumented: str
) -> Callable[[Callable[[bytes], None]], Callable[[bytes], None]]:
    """Register the function below as the target of a format; arguments as the fields of ``FuzzedFormat``."""

    def register(read: Callable[[bytes], None]) -> Callable[[bytes], None]:
        FORMATS[name] = FuzzedFormat(name, read, mutate, ("torchcloth._utils.unpacking", *instrumented))
        return read

    return register


def is_accepted(fuzzed: FuzzedFormat, data: bytes) -> bool:
    """Read one input, and return whether it was accepted; False if it was refused by one line.

    Raises:
        BrokenPromise: what was accepted breaks an invariant, or the message of the refusal could harm a terminal.
        Exception: whatever else the reader raised; it may raise nothing but ``TorchclothError``.
    """
    try:
        fuzzed.read(data)
    except MissingDependency:
        raise
    except TorchclothError as error:
        message = str(error)
        require("\n" not in message and not has_control_characters(message), "a refusal is one printable line")
        require(len(message) <= MAX_MESSAGE_CHARACTERS, "a refusal is short")
        return False
    return True


@contextmanager
def strict_arithmetic() -> Iterator[None]:
    """Turn warnings of overflow and of invalid numbers into errors, and ignore doubts about the content."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.simplefilter("error", RuntimeWarning)
        yield
