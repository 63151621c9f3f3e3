"""Tasks of the benchmark, and the interface of its contestants."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from .cases import Case, make_case

Quantity = Literal["forward", "gradient", "tangents8"]
TANGENT_DIRECTIONS = 8  # of the quantity "tangents8"


@dataclass(frozen=True)
class Task:
    """One computation to be timed.

    Attributes:
        case: name of the case.
        quantity: "forward": positions at the end. "gradient": forward and backward of the end's mean squared position,
            by initial positions, Young's modulus and, where it exists, the grippers' poses. "tangents8": derivatives of
            the frames along eight directions of the parameters.
        substeps: of the simulation.
        batch: scenes at once; 0: no batch dimension.
        small: the scene on a small mesh.
    """

    case: str
    quantity: Quantity
    substeps: int
    batch: int = 0
    small: bool = False

    def build_case(self) -> Case:
        """Return the case to simulate."""
        return make_case(self.case, self.small)


class Outcome(NamedTuple):
    """Result of a run.

    Attributes:
        x: [V, 3] m, positions at the end, of the first scene of a batch.
        loss: m^2, mean squared position at the end.
        gradient_x: [V, 3] m, derivative of the loss by the initial positions.
        gradient_youngs: m^2/Pa, derivative of the loss by Young's modulus.
        extra: other derivatives, which must be finite.
    """

    x: np.ndarray
    loss: float = 0.0
    gradient_x: np.ndarray | None = None
    gradient_youngs: float = 0.0
    extra: tuple[np.ndarray, ...] = ()


class Unsupported(Exception):
    """A contestant cannot do a task; the text says why."""


class Contestant(ABC):
    """A simulator on this machine.

    Attributes:
        threads: threads that it uses.
    """

    threads: int = 1

    @abstractmethod
    def prepare(self, task: Task) -> Callable[[], Outcome]:
        """Build and compile everything; return the computation, which is run and timed many times.

        Raises:
            Unsupported: this contestant cannot do the task.
        """
