"""What a case of the verification is: what was measured, what it should be, and the mark it must meet."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from torchcloth.errors import InvalidInput

Kind = Literal["relative", "absolute", "at most", "at least"]
CASES: dict[str, Case] = {}


class NotThere(Exception):
    """What the case measures has not been built yet; its mark counts as missed."""


@dataclass(frozen=True)
class Mark:
    """How far from the truth a figure may be.

    ``relative`` and ``absolute`` limit the difference. For ``at most`` and ``at least`` the truth is a bound and
    ``limit`` what may be missing to it (0).
    """

    limit: float
    kind: Kind = "relative"

    def error(self, measured: float, truth: float) -> float:
        difference = measured - truth
        if self.kind == "relative":
            return abs(difference / truth)
        if self.kind == "absolute":
            return abs(difference)
        beyond = difference if self.kind == "at most" else -difference
        return beyond if beyond > 0 or beyond != beyond else 0.0


@dataclass(frozen=True)
class Row:
    """One figure. ``mark`` None takes the case's; a ``finding`` is reported and not judged."""

    label: str
    measured: float
    truth: float | None = None
    unit: str = ""
    mark: Mark | None = None
    finding: bool = False


@dataclass(frozen=True)
class Outcome:
    """What a case returns: figures, arrays for its picture, and what must be known to read them."""

    rows: list[Row]
    data: Mapping[str, np.ndarray] = field(default_factory=dict)
    note: str = ""


@dataclass(frozen=True)
class Case:
    """A registered case. ``function(fast)`` measures; ``draw(figure, data)`` makes its picture from the arrays."""

    name: str
    title: str
    theme: str
    truth: str  # where the truth comes from
    mark: Mark | None  # None: every row brings its own
    function: Callable[[bool], Outcome]
    draw: Callable[[Any, Mapping[str, np.ndarray]], None] | None = None
    fast: bool = True  # belongs to the coarse subset


def case(
    name: str,
    title: str,
    *,
    truth: str,
    mark: Mark | None = None,
    draw: Callable[[Any, Mapping[str, np.ndarray]], None] | None = None,
    fast: bool = True,
    into: dict[str, Case] = CASES,
):
    """Decorator that registers a function ``(fast) -> Outcome`` as a case; its module's name is the theme.

    Raises:
        InvalidInput: the name is taken.
    """

    def register(function: Callable[[bool], Outcome]) -> Callable[[bool], Outcome]:
        if name in into:
            raise InvalidInput("case name", got=repr(name), expected="one that is not taken")
        theme = function.__module__.rsplit(".", 1)[-1]
        into[name] = Case(name, title, theme, truth, mark, function, draw, fast)
        return function

    return register


def relative(limit: float) -> Mark:
    return Mark(limit, "relative")


def absolute(limit: float) -> Mark:
    return Mark(limit, "absolute")


AT_MOST, AT_LEAST = Mark(0.0, "at most"), Mark(0.0, "at least")
