"""What is said of one parameter."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Estimate:
    """One parameter. ``identifiable`` is False when the data leave it within its prior, whatever its value says."""

    value: float
    std: float
    ci95: tuple[float, float]
    unit: str
    initial: float
    identifiable: bool
    source: str = (
        "data"  # "data", "prior" (a measurement stated by the recording), "derived", "not in the model", "held fixed"
    )


@dataclass(frozen=True)
class Influence:
    """What the data can tell of one parameter."""

    identifiable: bool
    statement: str
    prior_mm: float  # the cloth moves by, rms, for one standard deviation of the prior
    tenth_mm: float  # for 10 % of the value
    prior_newton: float
    tenth_newton: float
    experiment: str


@dataclass(frozen=True)
class Profile:
    """How the cost of the best fit rises with one parameter."""

    values: list[float]
    rise: list[float]  # above the optimum's, scaled to the curvature of the standard error: 1.92 at an interval's end
    ci95: tuple[float | None, float | None]  # None: open, the cost does not rise enough
    skew: float | None  # upper over lower part of the interval, in the unconstrained coordinate; None: open


@dataclass(frozen=True)
class Combination:
    """A product of powers (a sum, near zero) of parameters, and the relative error that the data leave of it."""

    powers: dict[str, float]
    std: float
    determined: bool

    @property
    def text(self) -> str:
        """E.g. "youngs_modulus · areal_density^-0.97"."""
        return " · ".join(n if abs(p - 1) < 0.005 else f"{n}^{p:.2g}" for n, p in self.powers.items())
