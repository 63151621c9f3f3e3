"""Errors whose text says what is wrong, what was got, what was expected, and what to do."""

from __future__ import annotations


class TorchclothError(ValueError):
    """Base of every error that torchcloth raises on purpose; its text is one line.

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
        super().__init__("; ".join(" ".join(part.split()) for part in parts))

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
