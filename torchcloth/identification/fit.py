"""``identify``: fit the parameters of a cloth to recordings."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any, Literal

import torch
from torch import Tensor

from ..cloth import Cloth
from ..errors import InvalidInput
from ..recordings import Recording
from . import gauss_newton
from .descent import descend
from .episodes import Episode, episode
from .misfit import Figures, figures, rows
from .null import rigid_carry
from .replays import simulate, tangents
from .report import estimates, warnings_of
from .result import Identification
from .unknowns import Unknown, collect

PAPER_ITERATIONS, PAPER_CHAMFER = 35, 0.015  # the DiffCP paper's stop rule: iterations, metres

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
    run = _Run(cloth, unknowns, [episode(cloth, r) for r in episodes_in], stop, on_progress)
    return run.solve(method, iterations, rate)


def default_parameters(cloth: Cloth) -> list[str]:
    """Membrane parameters, contact parameters if the model has contact, and the amplitudes of air."""
    names = [name for name, _ in cloth.material.named_children()]
    if cloth.contact is None:
        names = [name for name in names if name in ("youngs_modulus", "poisson_ratio")]
    return names + [f"{key}.normal" for key, effect in cloth.effects.items() if hasattr(effect, "normal")]


class _Run:
    """State of one fit: counts simulations, keeps the history, knows when to stop."""

    def __init__(
        self,
        cloth: Cloth,
        unknowns: list[Unknown],
        episodes: list[Episode],
        stop: str,
        on_progress: Progress | None,
    ) -> None:
        self.cloth, self.unknowns, self.episodes = cloth, unknowns, episodes
        self.stop, self.on_progress = stop, on_progress
        self.faces = torch.as_tensor(cloth.mesh.faces)
        self.start = torch.tensor([u.start for u in unknowns], dtype=torch.float64)
        self.history: list[dict[str, Any]] = []
        self.frames: dict[tuple[float, ...], list[Tensor]] = {}
        self.simulations, self.began = 0, time.perf_counter()

    def solve(self, method: str, iterations: int, rate: float) -> Identification:
        null = [rigid_carry(e) for e in self.episodes]
        problem = self._problem()
        if method == "adam":
            raw = descend(
                self.cloth, self.unknowns, self.episodes, self.start, iterations, rate, self._record_descent
            )  # fmt: skip
            final = gauss_newton.minimise(problem, raw, 0, lambda _: True)
        else:
            final = gauss_newton.minimise(problem, self.start, iterations, lambda it: self._record(it.raw))
        before = self._frames(self.start)
        after = self._frames(final.raw)
        found = estimates(self.cloth, self.unknowns, final.raw, gauss_newton.covariance(problem, final))
        distances = [figures(x, self.episodes, self.faces) for x in (before, after, null)]
        fit = self._fit_figures(*distances)
        warnings = warnings_of(self.cloth, self.episodes, found, fit, after, self.faces)
        keys = {u.name: u.key.removesuffix(".raw") for u in self.unknowns}
        return Identification(
            found.parameters, fit, found.correlation, warnings, self.history, before, after, null, keys
        )

    def _problem(self) -> gauss_newton.Problem:
        noises = [e.noise for e in self.episodes if e.noise is not None]
        return gauss_newton.Problem(
            linearise=self._linearise,
            evaluate=self._evaluate,
            clip=lambda raw: torch.tensor(
                [u.clip(float(r)) for u, r in zip(self.unknowns, raw, strict=True)], dtype=raw.dtype
            ),
            prior_mean=self.start,
            prior_std=torch.tensor([u.prior_std for u in self.unknowns], dtype=torch.float64),
            noise=max(noises) if noises else None,
        )

    def _linearise(self, raw: Tensor) -> gauss_newton.Linearised:
        parts, frames, clusters, first = [], [], [], 0
        for e in self.episodes:
            x, tangent = tangents(self.cloth, self.unknowns, raw, e)
            frames.append(x)
            parts.append(rows(x, tangent, e, self.faces))
            clusters.append(parts[-1].frame + first)
            first += len(e.clouds)
        self.simulations += len(self.unknowns) * len(self.episodes)
        self._remember(raw, frames)
        jacobian = torch.cat([p.jacobian for p in parts if p.jacobian is not None])
        value, factor = torch.cat([p.value for p in parts]), torch.cat([p.factor for p in parts])
        double = torch.float64
        return gauss_newton.Linearised(value.to(double), jacobian.to(double), factor.to(double), torch.cat(clusters))

    def _evaluate(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        frames = self._frames(raw)
        parts = [rows(x, None, e, self.faces) for x, e in zip(frames, self.episodes, strict=True)]
        return (
            torch.cat([p.value for p in parts]).to(torch.float64),
            torch.cat([p.factor for p in parts]).to(torch.float64),
        )

    def _frames(self, raw: Tensor) -> list[Tensor]:
        key = tuple(raw.tolist())
        if key not in self.frames:
            with torch.no_grad():
                frames = [simulate(self.cloth, self.unknowns, raw, e) for e in self.episodes]
            self.simulations += len(self.episodes)
            self._remember(raw, frames)
        return self.frames[key]

    def _remember(self, raw: Tensor, frames: list[Tensor]) -> None:
        start = tuple(self.start.tolist())
        kept = {k: v for k, v in self.frames.items() if k == start or k == next(reversed(self.frames))}
        self.frames = {**kept, tuple(raw.tolist()): frames}

    def _record(self, raw: Tensor) -> bool:
        now = figures(self._frames(raw), self.episodes, self.faces)
        values = {u.name: u.value(float(r)) for u, r in zip(self.unknowns, raw, strict=True)}
        self.history.append({"iteration": len(self.history), "chamfer": now.chamfer, "rms": now.rms, **values})
        if self.on_progress is not None:
            self.on_progress(len(self.history) - 1, now.chamfer, values)
        return self.stop == "paper" and now.chamfer < PAPER_CHAMFER

    def _record_descent(self, raw: Tensor, frames: list[Tensor]) -> bool:
        self.simulations += len(self.episodes)
        self._remember(raw, frames)
        return self._record(raw)

    def _fit_figures(self, before: Figures, after: Figures, null: Figures) -> dict[str, float]:
        seconds = time.perf_counter() - self.began
        out: dict[str, float] = {
            "chamfer_before": before.chamfer,
            "chamfer_after": after.chamfer,
            "chamfer_null": null.chamfer,
            "rms_before": before.rms,
            "rms_after": after.rms,
            "rms_null": null.rms,
            "iterations": max(0, len(self.history) - 1),
            "simulations": self.simulations,
            "seconds": seconds,
            "stable_step": self.cloth.stable_step(),
        }
        if not all(math.isfinite(value) for value in out.values()):
            raise InvalidInput("fit", got=str(out), expected="finite figures")
        return out
