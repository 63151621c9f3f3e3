"""What is measured, and what every simulator in the benchmark must answer."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from .cases import Case, make

Quantity = Literal["forward", "gradient", "tangents8"]
DIRECTIONS = 8  # of "tangents8"


@dataclass(frozen=True)
class Task:
    """One thing to be timed.

    "forward": positions at the end. "gradient": forward and backward of the end's mean squared position, with respect
    to initial positions, Young's modulus and, where it exists, the grippers' poses. "tangents8": the frames'
    derivatives in eight directions of the parameters.
    """

    case: str
    quantity: Quantity
    substeps: int
    batch: int = 0  # 0: no batch dimension
    small: bool = False  # the scene on a small mesh

    def scene(self) -> Case:
        """What is simulated."""
        return make(self.case, self.small)


class Outcome(NamedTuple):
    """What a run computed."""

    x: np.ndarray  # [V, 3] m, at the end, of the first scene of a batch
    loss: float = 0.0  # m^2, mean squared position at the end
    by_x: np.ndarray | None = None  # [V, 3] m, derivative of the loss with respect to initial positions
    by_youngs: float = 0.0  # m^2/Pa
    extra: tuple[np.ndarray, ...] = ()  # other derivatives, which must be finite


class Unsupported(Exception):
    """A contestant does not offer this; the text says what it does instead."""


class Contestant(ABC):
    """A simulator on this machine."""

    threads: int = 1

    @abstractmethod
    def prepare(self, task: Task) -> Callable[[], Outcome]:
        """Build and compile everything; what is returned is run and timed, many times.

        Raises:
            Unsupported: this contestant cannot do the task.
        """
