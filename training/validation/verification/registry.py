"""Cases of the verification: what was measured, what it should be, and how far it may be from that."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from torchcloth.errors import InvalidInput

ToleranceKind = Literal["relative", "absolute", "at most", "at least"]
FigureData = Mapping[str, np.ndarray]
DrawFunction = Callable[[Any, FigureData], None]
CASES: dict[str, Case] = {}


@dataclass(frozen=True)
class Tolerance:
    """How far from the truth a figure may be.

    Attributes:
        limit: largest error.
        kind: "relative" and "absolute" limit the difference. For "at most" and "at least" the truth is a bound, and
            ``limit`` is how far the figure may be beyond it.
    """

    limit: float
    kind: ToleranceKind = "relative"

    def error(self, measured: float, truth: float) -> float:
        """Return the error of a measured value."""
        difference = measured - truth
        if self.kind == "relative":
            return abs(difference / truth)
        if self.kind == "absolute":
            return abs(difference)
        excess = difference if self.kind == "at most" else -difference
        return excess if excess > 0 or excess != excess else 0.0


@dataclass(frozen=True)
class Row:
    """One measured figure.

    Attributes:
        label: says what was measured.
        measured: value.
        truth: value; None: there is none.
        unit: of both.
        tolerance: None takes the case's.
        finding: the figure is reported, without a tolerance.
    """

    label: str
    measured: float
    truth: float | None = None
    unit: str = ""
    tolerance: Tolerance | None = None
    finding: bool = False


@dataclass(frozen=True)
class Outcome:
    """Result of a case.

    Attributes:
        rows: figures.
        data: arrays for the picture.
        note: what a reader of the figures must know.
    """

    rows: list[Row]
    data: FigureData = field(default_factory=dict)
    note: str = ""


@dataclass(frozen=True)
class Case:
    """A registered case.

    Attributes:
        name: on the command line.
        title: on the page.
        theme: section of the page.
        truth: where the truth comes from.
        tolerance: of all rows without their own; None: every row has its own.
        function: measures; its argument asks for a fast, coarse version.
        draw: makes the picture from the arrays.
        fast: belongs to the coarse subset.
    """

    name: str
    title: str
    theme: str
    truth: str
    tolerance: Tolerance | None
    function: Callable[[bool], Outcome]
    draw: DrawFunction | None = None
    fast: bool = True


def register_case(
    name: str,
    title: str,
    *,
    truth: str,
    tolerance: Tolerance | None = None,
    draw: DrawFunction | None = None,
    fast: bool = True,
    into: dict[str, Case] = CASES,
):
    """Return a decorator that registers a function ``(fast) -> Outcome`` as a case; its module's name is the theme.

    Raises:
        InvalidInput: the name is taken.
    """

    def register(function: Callable[[bool], Outcome]) -> Callable[[bool], Outcome]:
        if name in into:
            raise InvalidInput("case name", got=repr(name), expected="one that is not taken")
        theme = function.__module__.rsplit(".", 1)[-1]
        into[name] = Case(name, title, theme, truth, tolerance, function, draw, fast)
        return function

    return register


def relative(limit: float) -> Tolerance:
    """Return a tolerance of the relative error."""
    return Tolerance(limit, "relative")


def absolute(limit: float) -> Tolerance:
    """Return a tolerance of the absolute error, in the figure's unit."""
    return Tolerance(limit, "absolute")


AT_MOST_TRUTH, AT_LEAST_TRUTH = Tolerance(0.0, "at most"), Tolerance(0.0, "at least")
