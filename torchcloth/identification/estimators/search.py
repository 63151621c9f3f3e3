"""One search for the unknowns, by any estimator: its history, when it stops, and from where it begins."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

from torch import Tensor

from ...errors import SimulationDiverged, UnstableStep
from ..uncertainty.reporting import undecided
from . import levenberg_marquardt, linearity, multistart, predictability, statistical_linearisation
from .convergence import astray
from .gradient_descent import descend, quasi_newton, to_vertices
from .objective import Objective

Method = Literal["gauss-newton", "lbfgs", "adam", "gradient-descent"]
METHODS: tuple[str, ...] = ("gauss-newton", "lbfgs", "adam", "gradient-descent")
CHAMFER = METHODS[2:]  # those that follow the paper's distance alone
PAPER_CHAMFER = 0.015  # m, the DiffCP paper's stop rule
EARLY = 0.35  # share of the frames that the first stage of the fit sees
EARLY_ITERATIONS = 10
RIPPLES = "simulations around the solution know what is near, not what is best"
GO_ON = "more iterations of Gauss-Newton, a nearer start or several, or fewer parameters at once may get there"

Progress = Callable[[int, float, dict[str, float], float], None]  # iteration, Chamfer, values, share of the frames


class Outcome(NamedTuple):
    """Where a search ended."""

    objective: Objective  # of the frames that told it
    checked: linearity.Checked
    unfinished: str  # why the end may not be the optimum; empty where it is
    reached: multistart.Reached | None  # with several starts


class Search:
    """Keeps the history and knows when to stop; ``strata`` [E]: ``replicates.strata_of``."""

    def __init__(
        self, objective: Objective, stop: str, on_progress: Progress | None, strata: Tensor | None = None
    ) -> None:
        self.objective, self.stop, self.on_progress, self.strata = objective, stop, on_progress, strata
        self.history: list[dict[str, Any]] = []
        self.elsewhere = 0  # simulations of parts of the episodes
        self.near = False  # stopped by the paper's rule

    @property
    def simulations(self) -> int:
        """Of all stages."""
        return self.elsewhere + self.objective.simulations

    def run(self, method: str, start: Tensor, iterations: int, rate: float, early: bool, count: int) -> Outcome:
        """From ``start`` [K], or from ``count`` starts around it, to the end."""
        full, reached = self.objective, None
        if count > 1:
            reached = self._from_several(start, count, iterations)
            start = reached.raw
        elif early and method == "gauss-newton":
            part = full.part(EARLY)
            start = self._early(part, start, iterations).raw if part.told else start
            self.elsewhere += part.simulations
        final = self._to_the_end(method, start, iterations, rate)
        checked = linearity.check(full, final)
        if checked.withdrawn and method not in CHAMFER and self.stop != "paper":
            told, checked = self._resolve(checked, start, iterations)
        else:
            told = full
        why = self._undecided() if method in CHAMFER else self._why()
        why = "" if checked.final.converged else why
        sure = not why and checked.covariance is None
        lost = "" if sure or checked.withdrawn else astray(told, checked)
        if lost:
            why = f"{why or RIPPLES}; {lost}, and no parameter counts as identified: {GO_ON}"
            checked = checked._replace(reason=lost)
        return Outcome(told, checked, why, reached)

    def _resolve(
        self, failed: linearity.Checked, start: Tensor, iterations: int
    ) -> tuple[Objective, linearity.Checked]:
        """Where tangents fail: what the beginning tells, and of the rest what is told by simulations spread around."""
        full = self.objective
        found = predictability.within(full, failed, start, self._judge)
        if found is not None and not undecided(found.objective, found.checked, self.strata):
            return found.objective, found.checked
        record = lambda raw: self.record(raw, full)  # noqa: E731
        wide = statistical_linearisation.resolved(full, failed, found, iterations, record, self.strata)
        if wide is None:
            return (full, failed) if found is None else (found.objective, found.checked)
        return full, wide

    def _to_the_end(self, method: str, start: Tensor, iterations: int, rate: float) -> levenberg_marquardt.Iterate:
        full = self.objective
        if method == "gauss-newton":
            return levenberg_marquardt.minimise(full.problem(), start, iterations, lambda it: self._judge(it, full))
        if method == "lbfgs":
            raw, done = quasi_newton(full, start, iterations, self.record)
        else:
            raw, done = descend(full, start, iterations, rate, self.record, adam=method == "adam"), False
        return levenberg_marquardt.minimise(full.problem(), raw, 0, lambda _: True)._replace(converged=done)

    def _judge(self, at: levenberg_marquardt.Iterate, objective: Objective) -> bool:
        """One more iteration; whether to stop, which tangents that run away are a reason for as well."""
        return self.record(at.raw, objective) or (at.exact and linearity.runaway(objective, at))

    def record(self, raw: Tensor, objective: Objective) -> bool:
        """One more iteration; whether the search may stop here."""
        now, values = objective.figures(raw), objective.values(raw)
        share = sum(e.observed for e in objective.episodes) / sum(e.observed for e in self.objective.episodes)
        entry = {"iteration": len(self.history), "frames": share, "chamfer": now.chamfer, "rms": now.rms}
        self.history.append({**entry, **values})
        if self.on_progress is not None:
            self.on_progress(len(self.history) - 1, now.chamfer, values, share)
        if self.stop == "paper" and objective is self.objective:
            pairs = zip(objective.frames(raw), objective.episodes, strict=True)
            losses = [float(to_vertices(frames, episode)) for frames, episode in pairs]
            self.near = sum(losses) / len(losses) < PAPER_CHAMFER
        return self.near

    def tell(self, at: levenberg_marquardt.Iterate) -> bool:
        """Of what is done after the search: progress, and no part of the history."""
        if self.on_progress is not None:
            now = self.objective.figures(at.raw).chamfer
            self.on_progress(len(self.history) - 1, now, self.objective.values(at.raw), 1.0)
        return False

    def _early(self, part: Objective, start: Tensor, iterations: int) -> levenberg_marquardt.Iterate:
        """On early frames, where a wrong start has not yet led the cloth elsewhere."""
        budget = min(EARLY_ITERATIONS, iterations)
        return levenberg_marquardt.minimise(
            part.problem(), start, budget, lambda it: self._judge(it, part), tolerance=1.0
        )

    def _from_several(self, start: Tensor, count: int, iterations: int) -> multistart.Reached:
        part, found = self.objective.part(EARLY), []
        part = part if part.told else self.objective
        for raw in multistart.spread(self.objective.unknowns, start, count):
            try:
                found.append(self._early(part, raw, iterations))
            except (SimulationDiverged, UnstableStep):
                if raw is start:
                    raise
        self.elsewhere += part.simulations if part is not self.objective else 0
        return multistart.best(part.problem(), found)

    def _why(self) -> str:
        if self.near:
            return "stopped by the paper's rule, Chamfer below 1.5 cm: the values still depend on the start"
        done = len(self.history) - 1
        return f"stopped after {done} iterations before converging: the search is unfinished, so are its errors"

    def _undecided(self) -> str:
        if self.near:
            return self._why()
        return "gradient descent has no test of convergence: values and errors may be those of an unfinished search"
