"""``identify``: fit the parameters of a cloth to recordings."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal, cast

import torch
from torch import Tensor

from ..cloth import Cloth
from ..effects import AbstractEffect
from ..errors import InvalidInput
from ..parameters import PhysicalParameter
from ..recordings import Recording
from . import gauss_newton
from .blocks import blocks_for
from .descent import descend
from .episodes import episode
from .misfit import Figures, figures
from .nuisances import chosen
from .null import rigid_carry
from .objective import Objective
from .report import estimates, nuisance_estimates, warnings_of, withdraw
from .result import Identification
from .unknowns import collect, with_priors

PAPER_ITERATIONS, PAPER_CHAMFER = 35, 0.015  # the DiffCP paper's stop rule: iterations, metres
ONLY_IN_CONTACT = ("contact_stiffness", "shear_stiffness", "cone")
EARLY = 0.35  # share of the frames that the first stage of the fit sees
EARLY_ITERATIONS = 10
NONLINEAR = 0.5  # relative error of the tangents over a finite step above which they are not used for errors
SMALLEST, LARGEST = 0.005, 0.1  # finite steps, in units of the prior's standard deviation

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
    guess: Mapping[str, float] | None = None,
    warm_start: bool = False,
    dt: float | None = None,
    use: Sequence[str] | None = None,
    nuisances: Mapping[str, float | None] | Sequence[str] = (),
    priors: Mapping[str, tuple[float, float]] | None = None,
    noise: Mapping[str, float] | None = None,
    on_progress: Progress | None = None,
) -> Identification:
    """Fit scalar parameters of a cloth to what was seen and felt, by gradients through the simulation.

    Args:
        cloth: model and start values; left unchanged (see ``Identification.apply``).
        recordings: one or several episodes of the same cloth.
        parameters: public names, e.g. ["youngs_modulus", "air.normal"]; None: all material parameters that the model
            contains, and the amplitudes of its effects.
        method: "gauss-newton" (robust point-to-surface residuals, forward-mode sensitivities) or "adam" (the paper's
            Chamfer distance to vertices, reverse mode).
        stop: "converged", or "paper": as soon as Chamfer (one-sided, cloud to surface) is below 1.5 cm.
        iterations: at most this many with all frames, and at most 10 with the early ones before.
        rate: learning rate of "adam", in unconstrained units (0.1: about 10 % a step).
        guess: values by name to start the search from, e.g. of an interrupted fit; the cloth's values stay the start
            that the result is compared with.
        warm_start: the guess is near the solution (an interrupted fit): skip the stage on the early frames.
        dt: largest substep [s]; None: the stable one, chosen anew for every set of values.
        use: kinds of data, some of "points", "markers" and "force"; None: all that an episode has.
        nuisances: what may differ from episode to episode: "clock" [s], "camera" [m], "grasp" [m], "shape" [m], "tare"
            [N]; as names, or with the standard deviation of the prior, e.g. {"clock": 0.4}. "rim" [m], an offset of the
            cloud's rim, always joins where points are used, unless it is given as 0.
        priors: by parameter (value, factor) for positive ones: 68 % within that factor; (value, standard deviation)
            for others. Default: around the start, a factor of 10 for positive parameters.
        noise: least standard deviation by kind of data: "points", "edges", "markers" [m], "force" [N], "torque" [N m].
        on_progress: called with (iteration, chamfer, values) after every iteration.

    Returns:
        Estimates with standard errors, distances, warnings, frames.

    Raises:
        InvalidInput: unknown names or options.
        RecordingError: a recording that lacks points or motion.
        SimulationDiverged: the start values cannot be simulated.
    """
    if method not in ("gauss-newton", "adam") or stop not in ("converged", "paper"):
        raise InvalidInput(
            "method or stop", got=f"{method!r}, {stop!r}", expected='"gauss-newton" or "adam"; "converged" or "paper"'
        )
    if iterations < 1:
        raise InvalidInput("iterations", got=iterations, expected="at least 1")
    episodes_in = [recordings] if isinstance(recordings, Recording) else list(recordings)
    if not episodes_in:
        raise InvalidInput("recordings", got="none", expected="at least one episode")
    names = default_parameters(cloth) if parameters is None else list(parameters)
    unknowns = with_priors(collect(cloth, names, episodes_in[0].cloth.areal_density_std), priors or {})
    if not unknowns:
        raise InvalidInput("parameters", got="none", expected="at least one name")
    blocks = blocks_for(use)
    episodes = [episode(cloth, r) for r in episodes_in]
    seen = any(block.name == "points" for block in blocks) and any(len(c) for e in episodes for c in e.clouds)
    objective = Objective(cloth, unknowns, episodes, dt, chosen(nuisances, implied=seen), blocks, noise)
    return _Run(objective, stop, on_progress).solve(
        method, iterations, rate, dict(guess or {}), early=not warm_start and stop != "paper"
    )


def default_parameters(cloth: Cloth) -> list[str]:
    """Membrane parameters, contact parameters if the model has contact, and each effect's main amplitude.

    Others (damping times, wind, curl) are fitted when they are named.
    """
    own = {name: part for name, part in cloth.material.named_modules() if isinstance(part, PhysicalParameter)}
    names = [name for name, part in own.items() if bool((part.value != 0).any())]
    if cloth.contact is None:
        names = [name for name in names if name not in ONLY_IN_CONTACT]
    for key, effect in cast("Iterable[tuple[str, AbstractEffect]]", cloth.effects.items()):
        main = next(iter(effect.amplitudes))
        if isinstance(getattr(effect, main), PhysicalParameter):
            names.append(f"{key}.{main}")
    return names


class _Run:
    """One fit: keeps the history, knows when to stop, turns the final point into statements."""

    def __init__(self, objective: Objective, stop: str, on_progress: Progress | None) -> None:
        self.objective, self.stop, self.on_progress = objective, stop, on_progress
        self.history: list[dict[str, Any]] = []
        self.simulations, self.began = 0, time.perf_counter()

    def solve(self, method: str, iterations: int, rate: float, guess: dict[str, float], early: bool) -> Identification:
        full = self.objective
        before = full.frames(full.start)
        start = full.raw(guess)
        if method == "adam":
            raw = descend(full, start, iterations, rate, self._record)
            final = gauss_newton.minimise(full.problem(), raw, 0, lambda _: True)
        else:
            final = self._gauss_newton(iterations, start, early)
        after = full.frames(final.raw)
        stopped = "" if final.converged else self._unfinished(method, iterations)
        final, warnings = self._check_linearity(final)
        rough = bool(warnings)
        covariance = gauss_newton.covariance(full.problem(), final)
        found = estimates(full.cloth, full.unknowns, final.raw, covariance)
        null = [rigid_carry(e) for e in full.episodes]
        distances = (figures(x, full.episodes, full.faces) for x in (before, after, null))
        fit: dict[str, Any] = self._fit_figures(*distances)
        fit |= self._counts(final)
        fit["converged"] = final.converged
        warnings += [stopped] if stopped else []
        if rough or fit["chamfer_after"] >= fit["chamfer_null"]:  # steep chaotic slopes promise tiny errors
            found = withdraw(found)
        warnings += warnings_of(full.cloth, full.episodes, found, fit, after, full.faces)
        keys = {u.name: u.key.removesuffix(".raw") for u in full.unknowns}
        nuisances = nuisance_estimates(full.episodes, full.placed, final.raw, covariance)
        return Identification(
            found.parameters, fit, found.correlation, warnings, self.history, before, after, null, keys, nuisances
        )

    def _gauss_newton(self, iterations: int, start: Tensor, early: bool) -> gauss_newton.Iterate:
        """First the early frames, where a wrong start has not yet led the cloth elsewhere; then all of them."""
        full = self.objective
        if early:
            part = full.part(EARLY)
            budget = min(EARLY_ITERATIONS, iterations)
            start = gauss_newton.minimise(
                part.problem(), start, budget, lambda it: self._record(it.raw, part), tolerance=1.0
            ).raw
            self.simulations += part.simulations
        return gauss_newton.minimise(full.problem(), start, iterations, lambda it: self._record(it.raw, full))

    def _unfinished(self, method: str, iterations: int) -> str:
        if method == "adam":
            return "gradient descent has no test of convergence: values and errors may be those of an unfinished search"
        if self.stop == "paper" and self.history[-1]["chamfer"] < PAPER_CHAMFER:
            return "stopped by the paper's rule, Chamfer below 1.5 cm: the values still depend on the start"
        return f"stopped after {iterations} iterations before converging: the search is unfinished, so are its errors"

    def _check_linearity(self, final: gauss_newton.Iterate) -> tuple[gauss_newton.Iterate, list[str]]:
        """Compare the tangents with finite steps of about a standard error; where they fail, differences replace them.

        Tangents are exact, but where the motion is unstable they describe a neighbourhood too small to matter.
        """
        full = self.objective
        deviation = gauss_newton.covariance(full.problem(), final).diagonal().sqrt()
        prior = full.problem().prior_std
        steps = torch.minimum(torch.maximum(deviation, SMALLEST * prior), LARGEST * prior)
        steps = steps[: len(full.unknowns)]
        secants = full.secants(final.raw, steps)
        weight = final.influence()[0].sqrt()[:, None]
        moved, slope = (weight * j[:, : len(steps)] for j in (secants.jacobian, final.linear.jacobian))
        missed = (moved - slope).norm(dim=0) / moved.norm(dim=0).clamp(min=1e-12)
        if float(missed.max()) < NONLINEAR:
            return final, []
        names = ", ".join(u.name for u, error in zip(full.unknowns, missed, strict=True) if error >= NONLINEAR)
        warning = (
            f"the motion is unstable or strongly nonlinear at the solution (tangents of {names} miss finite steps "
            f"by up to {min(1000.0, 100 * float(missed.max())):.0f} %): no parameter counts as identified"
        )
        return final._replace(linear=secants), [warning]

    def _counts(self, final: gauss_newton.Iterate) -> dict[str, float]:
        """Independent observations, in all and by kind of data, and how far each kind is off."""
        out, total = {}, 0.0
        for b, block in enumerate(self.objective.blocks):
            own = final.linear.value[final.linear.kind == b]
            own = own[own != 0]
            if len(own):
                out[f"{block.name}_residual"] = float(final.scale[b])
                total += float(final.share[b]) * len(own)
        return {"independent_observations": total, **out}

    def _record(self, raw: Tensor, objective: Objective) -> bool:
        now = figures(objective.frames(raw), objective.episodes, objective.faces)
        values = objective.values(raw)
        share = len(objective.episodes[0].clouds) / len(self.objective.episodes[0].clouds)
        entry = {"iteration": len(self.history), "frames": share, "chamfer": now.chamfer, "rms": now.rms}
        self.history.append({**entry, **values})
        if self.on_progress is not None:
            self.on_progress(len(self.history) - 1, now.chamfer, values)
        return self.stop == "paper" and objective is self.objective and now.chamfer < PAPER_CHAMFER

    def _fit_figures(self, before: Figures, after: Figures, null: Figures) -> dict[str, float]:
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
            "stable_step": self.objective.cloth.stable_step(),
        }
