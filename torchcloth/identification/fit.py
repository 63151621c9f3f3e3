"""``identify``: fit the parameters of a cloth to recordings."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, Literal

import torch
from torch import Tensor

from ..cloth import Cloth
from ..errors import InvalidInput
from ..parameters import PhysicalParameter
from ..recordings import Recording
from . import gauss_newton
from .descent import descend
from .episodes import episode
from .misfit import Figures, figures
from .null import rigid_carry
from .objective import Objective
from .report import estimates, warnings_of
from .result import Identification
from .unknowns import collect

PAPER_ITERATIONS, PAPER_CHAMFER = 35, 0.015  # the DiffCP paper's stop rule: iterations, metres
EARLY = 0.35  # share of the frames that the first stage of the fit sees
NONLINEAR = 0.5  # relative error of the tangents over one standard error above which they are not used for errors
SECANT = 0.01  # smallest finite step, in units of the prior's standard deviation

Progress = Callable[[int, float, dict[str, float]], None]


def identify(
    cloth: Cloth,
    recordings: Recording | Sequence[Recording],
    parameters: Sequence[str] | None = None,
    *,
    method: Literal["gauss-newton", "adam"] = "gauss-newton",
    stop: Literal["converged", "paper"] = "converged",
    iterations: int = PAPER_ITERATIONS,
    rate: float = 0.1,
    on_progress: Progress | None = None,
) -> Identification:
    """Fit scalar parameters of a cloth to point clouds, by gradients through the simulation.

    Args:
        cloth: model and start values; left unchanged (see ``Identification.apply``).
        recordings: one or several episodes of the same cloth.
        parameters: public names, e.g. ["youngs_modulus", "air.normal"]; None: all material parameters that the model
            contains, and the amplitudes of its effects.
        method: "gauss-newton" (robust point-to-surface residuals, forward-mode sensitivities) or "adam" (the paper's
            Chamfer distance to vertices, reverse mode).
        stop: "converged", or "paper": as soon as Chamfer (one-sided, cloud to surface) is below 1.5 cm.
        iterations: at most this many.
        rate: learning rate of "adam", in unconstrained units (0.1: about 10 % a step).
        on_progress: called with (iteration, chamfer, values) after every iteration.

    Returns:
        Estimates with standard errors, distances, warnings, frames.

    Raises:
        InvalidInput: unknown names or options.
        RecordingError: a recording that lacks points or motion.
        SimulationDiverged: the start values cannot be simulated.
    """
    if method not in ("gauss-newton", "adam") or stop not in ("converged", "paper"):
        raise InvalidInput("method or stop", got=f"{method!r}, {stop!r}", expected='"gauss-newton" or "adam"; "converged" or "paper"')  # fmt: skip
    if iterations < 1:
        raise InvalidInput("iterations", got=iterations, expected="at least 1")
    episodes_in = [recordings] if isinstance(recordings, Recording) else list(recordings)
    if not episodes_in:
        raise InvalidInput("recordings", got="none", expected="at least one episode")
    names = default_parameters(cloth) if parameters is None else list(parameters)
    unknowns = collect(cloth, names, episodes_in[0].cloth.areal_density_std)
    objective = Objective(cloth, unknowns, [episode(cloth, r) for r in episodes_in])
    return _Run(objective, stop, on_progress).solve(method, iterations, rate)


def default_parameters(cloth: Cloth) -> list[str]:
    """Membrane parameters, contact parameters if the model has contact, and the amplitudes of air."""
    names = [name for name, _ in cloth.material.named_children()]
    if cloth.contact is None:
        names = [name for name in names if name in ("youngs_modulus", "poisson_ratio")]
    for key, effect in cloth.effects.items():
        names += [f"{key}.{name}" for name, part in effect.named_children() if isinstance(part, PhysicalParameter)]
    return names


class _Run:
    """One fit: keeps the history, knows when to stop, turns the final point into statements."""

    def __init__(self, objective: Objective, stop: str, on_progress: Progress | None) -> None:
        self.objective, self.stop, self.on_progress = objective, stop, on_progress
        self.history: list[dict[str, Any]] = []
        self.simulations, self.began = 0, time.perf_counter()

    def solve(self, method: str, iterations: int, rate: float) -> Identification:
        full = self.objective
        before = full.frames(full.start)
        if method == "adam":
            raw = descend(full, iterations, rate, self._record)
            final = gauss_newton.minimise(full.problem(), raw, 0, lambda _: True)
        else:
            final = self._gauss_newton(iterations)
        after = full.frames(final.raw)
        final, warnings = self._check_linearity(final)
        covariance = gauss_newton.covariance(full.problem(), final)
        found = estimates(full.cloth, full.unknowns, final.raw, covariance)
        null = [rigid_carry(e) for e in full.episodes]
        distances = (figures(x, full.episodes, full.faces) for x in (before, after, null))
        fit = self._fit_figures(*distances, independent=final.share * float((final.linear.value != 0).sum()))
        warnings += warnings_of(full.cloth, full.episodes, found, fit, after, full.faces)
        keys = {u.name: u.key.removesuffix(".raw") for u in full.unknowns}
        return Identification(
            found.parameters, fit, found.correlation, warnings, self.history, before, after, null, keys
        )

    def _gauss_newton(self, iterations: int) -> gauss_newton.Iterate:
        """First the early frames, where a wrong start has not yet led the cloth elsewhere; then all of them."""
        full = self.objective
        early = Objective(full.cloth, full.unknowns, [e.until(EARLY) for e in full.episodes])
        first = gauss_newton.minimise(early.problem(), full.start, iterations, lambda it: self._record(it.raw, early))
        self.simulations += early.simulations
        left = max(1, iterations - len(self.history))
        return gauss_newton.minimise(full.problem(), first.raw, left, lambda it: self._record(it.raw, full))

    def _check_linearity(self, final: gauss_newton.Iterate) -> tuple[gauss_newton.Iterate, list[str]]:
        """Compare the tangents with a finite step of one standard error; where they fail, differences replace them."""
        full = self.objective
        covariance = gauss_newton.covariance(full.problem(), final)
        deviation = covariance.diagonal().sqrt()
        values, vectors = torch.linalg.eigh(covariance / deviation[:, None] / deviation[None, :])
        step = full.clip(final.raw + values[-1].sqrt() * vectors[:, -1] * deviation) - final.raw
        seen = full.evaluate(final.raw + step)[0] - final.linear.value
        told = final.linear.jacobian @ step
        error = float((seen - told).norm() / seen.norm().clamp(min=1e-12))
        if error < NONLINEAR:
            return final, []
        steps = torch.maximum(deviation, torch.tensor([SECANT * u.prior_std for u in full.unknowns]))
        linear = full.secants(final.raw, steps)
        warning = (
            f"the motion is unstable or strongly nonlinear at the solution (tangents miss a step of one standard error by "
            f"{100 * error:.0f} %): errors come from finite differences and are rough"
        )
        return final._replace(linear=linear), [warning]

    def _record(self, raw: Tensor, objective: Objective) -> bool:
        now = figures(objective.frames(raw), objective.episodes, objective.faces)
        values = objective.values(raw)
        share = len(objective.episodes[0].clouds) / len(self.objective.episodes[0].clouds)
        entry = {"iteration": len(self.history), "frames": share, "chamfer": now.chamfer, "rms": now.rms}
        self.history.append({**entry, **values})
        if self.on_progress is not None:
            self.on_progress(len(self.history) - 1, now.chamfer, values)
        return self.stop == "paper" and objective is self.objective and now.chamfer < PAPER_CHAMFER

    def _fit_figures(self, before: Figures, after: Figures, null: Figures, independent: float) -> dict[str, float]:
        return {
            "chamfer_before": before.chamfer,
            "chamfer_after": after.chamfer,
            "chamfer_null": null.chamfer,
            "rms_before": before.rms,
            "rms_after": after.rms,
            "rms_null": null.rms,
            "iterations": max(0, len(self.history) - 1),
            "simulations": self.simulations + self.objective.simulations,
            "seconds": time.perf_counter() - self.began,
            "points": sum(len(c) for e in self.objective.episodes for c in e.clouds),
            "independent_observations": independent,
            "stable_step": self.objective.cloth.stable_step(),
        }
