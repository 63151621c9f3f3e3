"""Errors that tell a person what to do: what is wrong, what was got, what was expected, and the remedy."""

from __future__ import annotations


class TorchclothError(ValueError):
    """Base of every error that torchcloth raises on purpose; its text is one line.

    Args:
        what: the thing that is wrong, in the caller's own argument names.
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
    """An argument that no simulation can be made from."""


class RecordingError(TorchclothError):
    """An episode on disk that cannot be trusted."""


class UnstableStep(TorchclothError):
    """A time step beyond the stability limit of the explicit integration."""


class SimulationDiverged(TorchclothError):
    """The state lost finiteness; names the step and the first vertex."""


class MissingDependency(TorchclothError, ImportError):
    """An optional package that the called feature needs."""
