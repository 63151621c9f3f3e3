"""What an export wrote, and what it could not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Parameter:
    """One number of the target.

    Attributes:
        name: as the target calls it.
        value: in the target's unit.
        unit: of the value.
        meaning: where it comes from.
    """

    name: str
    value: float
    unit: str
    meaning: str


@dataclass(frozen=True)
class Export:
    """A cloth in another engine's words.

    Attributes:
        target: "mujoco", "newton" or "usd".
        text: content of the file.
        parameters: the numbers in it that describe the fabric.
        notes: what the fit does not know and the target does not express, a sentence each.
    """

    target: str
    text: str
    parameters: Sequence[Parameter]
    notes: Sequence[str]


def describe_direction_spread(rigidity: np.ndarray) -> str:
    """Return a sentence on hinges whose rigidity [N m] depends on the direction of bending."""
    low, high = (100 * (value / rigidity.mean() - 1) for value in (rigidity.min(), rigidity.max()))
    return (
        f"hinges bend this mesh by {low:+.0f} to {high:+.0f} % of the bending stiffness, depending on the direction; "
        "right is the mean over all directions"
    )
