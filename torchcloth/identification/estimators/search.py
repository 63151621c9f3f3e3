"""One search for the unknowns by any estimator: its history, when it stops, and where it begins."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

from torch import Tensor

from ...errors import SimulationDiverged, UnstableStep
from ..nuisances import StampJitter
from ..uncertainty.consider_covariance import points_misfit, solution_covariance
from ..uncertainty.estimates import make_estimates
from ..uncertainty.misfit import find_misfit
from . import cross_entropy, levenberg_marquardt, linearity, multistart, predictability, statistical_linearisation
from .convergence import find_failure_reason
from .gradient_descent import chamfer_to_nearest_vertex, minimise_by_gradient_descent, minimise_by_lbfgs
from .objective import Objective

Method = Literal["gauss-newton", "lbfgs", "adam", "gradient-descent"]
ESTIMATION_METHODS: tuple[str, ...] = ("gauss-newton", "lbfgs", "adam", "gradient-descent")
CHAMFER_METHODS = ESTIMATION_METHODS[2:]  # these minimise the paper's distance alone
PAPER_STOP_CHAMFER_M = 0.015  # stop rule of the DiffCP paper
EARLY_FRAME_FRACTION = 0.35  # of the frames, in the first stage of the fit
MAX_EARLY_ITERATIONS = 10
EARLY_TOLERANCE_STD_ERRORS = 1.0  # of a step that ends the first stage
NEAR_OPTIMUM_NOTE = (
    "its end is near enough to the optimum to count: the slopes there lead at most one standard error farther, and the "
    "standard errors include that step"
)
MIN_APPROACH_RATIO = 0.8  # of the misfit that a round of simulations leaves, to that before, for another round
HOPED_STD_RATIO = 2.0  # by which standard errors may yet fall in more rounds of simulations around a solution
MAX_STAMP_ROUNDS = 2  # searches that follow a new estimate of the stamps' scatter
MIN_STAMP_STD_CHANGE = 0.2  # of the scatter of the stamps, for another search
SAMPLED_FIT_NOTE = "simulations around the solution know what is near, not what is best"
UNFINISHED_REMEDY = (
    "more iterations of Gauss-Newton, a nearer start or several, or fewer parameters at once may get there"
)

Progress = Callable[[int, float, dict[str, float], float], None]  # iteration, Chamfer [m], values, fraction of frames


class Outcome(NamedTuple):
    """Where a search ended.

    Attributes:
        objective_used: of the frames that the solution is from.
        checked: the solution.
        unfinished_reason: why the end may not be the optimum. Empty where it is.
        multistart: what several starts led to; None with a single start.
    """

    objective_used: Objective
    checked: linearity.LinearityCheck
    unfinished_reason: str
    multistart: multistart.MultistartResult | None


class Search:
    """Runs an estimator, keeps its history and decides when it stops.

    Args:
        objective: of all frames.
        stop: "converged" or "paper".
        on_progress: called after every iteration.
        strata: [E] groups of replicates (``replicates.assign_strata``).
        noise_std: of the points [m], against which their misfit counts.

    Attributes:
        history: one entry per iteration.
        partial_simulations: number of simulations of parts of the episodes.
        reached_paper_threshold: whether the paper's rule stopped the search.
    """

    def __init__(
        self,
        objective: Objective,
        stop: str,
        on_progress: Progress | None,
        strata: Tensor | None = None,
        noise_std: float = math.inf,
    ) -> None:
        self.objective, self.stop, self.on_progress = objective, stop, on_progress
        self.strata, self.noise_std, self._least_misfit = strata, noise_std, math.inf
        self.history: list[dict[str, Any]] = []
        self.partial_simulations = 0
        self.reached_paper_threshold = False

    @property
    def simulations(self) -> int:
        """Number of simulations of all stages."""
        return self.partial_simulations + self.objective.simulations

    def run(self, method: str, start: Tensor, iterations: int, rate: float, early: bool, count: int) -> Outcome:
        """Search from ``start`` [K], or from ``count`` starts around it, to the end.

        Args:
            method: one of ``ESTIMATION_METHODS``.
            start: [K].
            iterations: largest number of steps on all frames.
            rate: of gradient descent.
            early: fit the early frames first.
            count: number of starts.
        """
        self._estimate_stamps(start)
        full, starts, origin = self.objective, None, start
        if count > 1:
            starts = self._search_from_several(start, count, iterations)
            start = starts.raw
        elif early and method == "gauss-newton":
            start = self._fit_roughly(full.first_fraction(EARLY_FRAME_FRACTION), start, iterations)
            if _has_unknown_bench(full):
                start = self._fit_roughly(full, start, iterations)
        checked = self._fit_and_check(method, start, iterations, rate)
        if early and method == "gauss-newton" and _has_unknown_bench(full) and self._has_failed(checked):
            checked = self._search_again(checked, origin, iterations)
        full = self.objective
        if checked.is_withdrawn and method not in CHAMFER_METHODS and self.stop != "paper":
            used, checked = self._resolve_unstable(checked, start, iterations)
        else:
            used = full
        reason = "" if checked.final.converged else self._unfinished_reason(method)
        is_regular = not reason and checked.covariance is None
        failure = "" if is_regular or checked.is_withdrawn else find_failure_reason(used, checked)
        if failure:
            reason = (
                f"{reason or SAMPLED_FIT_NOTE}; {failure}, and no parameter counts as identified: {UNFINISHED_REMEDY}"
            )
            checked = checked._replace(failure_reason=failure)
        elif reason and not checked.is_withdrawn:
            reason = f"{reason}; {NEAR_OPTIMUM_NOTE}"
        return Outcome(used, checked, reason, starts)

    def _estimate_stamps(self, raw: Tensor) -> bool:
        """Estimate the scatter of the stamps at a point; tell whether it differs from what the search assumed."""
        objective, before = self.objective, self.objective.frame_times
        jitter = next((n for n in objective.nuisances if isinstance(n, StampJitter)), None)
        if jitter is None or not objective.uses("points", "markers") or (before and not jitter.is_estimated):
            return False
        after = objective.estimate_frame_times(raw, None if jitter.is_estimated else jitter.std)
        stds = [0.0 if times is None else times.std for times in (before, after)]
        if abs(stds[1] - stds[0]) <= MIN_STAMP_STD_CHANGE * max(stds):
            return False
        self.objective = objective.with_frame_times(after)
        return True

    def _resolve_unstable(
        self, failed: linearity.LinearityCheck, start: Tensor, iterations: int
    ) -> tuple[Objective, linearity.LinearityCheck]:
        """Where tangents fail: fit the predictable beginning, then the rest by simulations spread around it."""
        full = self.objective
        beginning = predictability.fit_predictable_part(full, failed, start, self._append_iterate)
        if beginning is not None:
            undecided = self._undecided_parameters(beginning.objective, beginning.checked)
            fitted = [u.name for u in full.unknowns if not u.measured]
            # a round of simulations costs two for each unknown, and a bench has dozens
            if not undecided or (_has_unknown_bench(full) and len(undecided) < len(fitted)):
                return beginning.objective, beginning.checked

        def on_round(raw: Tensor) -> bool:
            return self.append_history(raw, full)

        self._least_misfit = points_misfit(full, failed.final) or 0.0
        sampled = statistical_linearisation.fit_by_sampling(
            full, failed, beginning, iterations, on_round, self.strata, self._could_identify
        )
        if sampled is None:
            return (full, failed) if beginning is None else (beginning.objective, beginning.checked)
        return full, sampled

    def _could_identify(self, at: levenberg_marquardt.Iterate, covariance: Tensor) -> bool:
        """Whether with smaller standard errors any parameter would be identified that was not measured.

        None would, if the model does not describe the data and the search comes no nearer to them.
        """
        unknowns, hoped = self.objective.unknowns, covariance / HOPED_STD_RATIO**2
        misfit, before = points_misfit(self.objective, at) or 0.0, self._least_misfit
        self._least_misfit = min(misfit, before)
        if find_misfit(misfit, self.noise_std) and not misfit < MIN_APPROACH_RATIO * before:
            return False
        estimates = make_estimates(self.objective.cloth, unknowns, at.raw, hoped).parameters
        return any(estimates[u.name].identifiable for u in unknowns if not u.measured)

    def _undecided_parameters(self, objective: Objective, checked: linearity.LinearityCheck) -> list[str]:
        """Names of fitted parameters that a solution does not identify."""
        covariance = solution_covariance(objective, checked, self.strata)
        estimates = make_estimates(objective.cloth, objective.unknowns, checked.final.raw, covariance).parameters
        return [u.name for u in objective.unknowns if not (u.measured or estimates[u.name].identifiable)]

    def _fit_all_frames(self, method: str, start: Tensor, iterations: int, rate: float) -> levenberg_marquardt.Iterate:
        full = self.objective
        if method == "gauss-newton":
            return levenberg_marquardt.minimise(
                full.problem(), start, iterations, lambda it: self._append_iterate(it, full)
            )
        if method == "lbfgs":
            raw, converged = minimise_by_lbfgs(full, start, iterations, self.append_history)
        else:
            adam, converged = method == "adam", False
            raw = minimise_by_gradient_descent(full, start, iterations, rate, self.append_history, adam)
        return levenberg_marquardt.minimise(full.problem(), raw, 0, lambda _: True)._replace(converged=converged)

    def _append_iterate(self, at: levenberg_marquardt.Iterate, objective: Objective) -> bool:
        """Record an iteration and tell whether to stop; tangents that run away are a reason as well."""
        should_stop = self.append_history(at.raw, objective)
        return should_stop or (at.exact and linearity.has_runaway_tangents(objective, at))

    def append_history(self, raw: Tensor, objective: Objective) -> bool:
        """Record an iteration, and tell whether the search may stop here."""
        metrics, values = objective.distance_metrics(raw), objective.physical_values(raw)
        used, total = (sum(e.observed_count for e in o.episodes) for o in (objective, self.objective))
        fraction = used / total
        entry = {
            "iteration": len(self.history),
            "frame_fraction": fraction,
            "chamfer": metrics.chamfer,
            "rms": metrics.rms,
        }
        self.history.append({**entry, **values})
        if self.on_progress is not None:
            self.on_progress(len(self.history) - 1, metrics.chamfer, values, fraction)
        if self.stop == "paper" and objective is self.objective:
            pairs = zip(objective.simulate_vertices(raw), objective.episodes, strict=True)
            losses = [float(chamfer_to_nearest_vertex(frames, episode)) for frames, episode in pairs]
            self.reached_paper_threshold = sum(losses) / len(losses) < PAPER_STOP_CHAMFER_M
        return self.reached_paper_threshold

    def report_progress(self, at: levenberg_marquardt.Iterate) -> bool:
        """Report progress of work after the search, which is no part of the history; never ask to stop."""
        if self.on_progress is not None:
            chamfer = self.objective.distance_metrics(at.raw).chamfer
            self.on_progress(len(self.history) - 1, chamfer, self.objective.physical_values(at.raw), 1.0)
        return False

    def _fit_roughly(self, part: Objective, start: Tensor, iterations: int) -> Tensor:
        """Fit frames as far as is cheap: without nuisances that act on the cloth, whose slopes need simulations."""
        rough = part.with_nuisances([n for n in part.nuisances if not n.acts_on_cloth])
        if not rough.has_data:
            return start
        full, begin = self.objective, rough.take_unknowns(start, self.objective)
        end = self._fit_early_frames(rough, begin, iterations).raw
        self.partial_simulations += rough.simulations
        return full.take_unknowns(end, rough)

    def _fit_and_check(self, method: str, start: Tensor, iterations: int, rate: float) -> linearity.LinearityCheck:
        """Fit all frames, again where the stamps scatter otherwise than assumed, and check the slopes at the end."""
        final = self._fit_all_frames(method, start, iterations, rate)
        for _ in range(MAX_STAMP_ROUNDS):
            if not self._estimate_stamps(final.raw):
                break
            final = self._fit_all_frames(method, final.raw, iterations, rate)
        return linearity.check_linearity(self.objective, final)

    def _has_failed(self, checked: linearity.LinearityCheck) -> bool:
        """Whether slopes led to an end that says nothing."""
        misfit = points_misfit(self.objective, checked.final) or 0.0
        has_failed = checked.is_withdrawn or bool(find_misfit(misfit, self.noise_std))
        return has_failed or not (checked.final.converged or not find_failure_reason(self.objective, checked))

    def _search_again(
        self, first: linearity.LinearityCheck, origin: Tensor, iterations: int
    ) -> linearity.LinearityCheck:
        """Search from the best of many simulations around a start, and return the better end of the two."""
        checked = self._fit_and_check("gauss-newton", self._search_by_draws(origin), iterations, 0.0)
        before, after = multistart.comparable_costs(self.objective.problem(), [first.final, checked.final])
        return checked if after < before else first

    def _search_by_draws(self, start: Tensor) -> Tensor:
        """Search by simulations of fabrics alone, with the errors of the observer that are numbers of the search."""
        full = self.objective
        nuisances = [n for n in full.nuisances if not n.acts_on_cloth]
        thinned = full.with_thinned_clouds(cross_entropy.CROSS_ENTROPY_SETTINGS.points_per_frame)
        rough = thinned.with_nuisances(nuisances).with_frame_times(None)
        end = cross_entropy.search_by_draws(
            rough, rough.take_unknowns(start, full), lambda raw: self.append_history(raw, rough)
        )
        self.partial_simulations += rough.simulations
        return full.take_unknowns(end, rough)

    def _fit_early_frames(self, part: Objective, start: Tensor, iterations: int) -> levenberg_marquardt.Iterate:
        """Fit early frames, in which a wrong start has not yet led the cloth elsewhere."""
        return levenberg_marquardt.minimise(
            part.problem(),
            start,
            min(MAX_EARLY_ITERATIONS, iterations),
            lambda it: self._append_iterate(it, part),
            tolerance=EARLY_TOLERANCE_STD_ERRORS,
        )

    def _search_from_several(self, start: Tensor, count: int, iterations: int) -> multistart.MultistartResult:
        part, ends = self.objective.first_fraction(EARLY_FRAME_FRACTION), []
        part = part if part.has_data else self.objective
        for raw in multistart.sample_starts(self.objective.unknowns, start, count):
            try:
                ends.append(self._fit_early_frames(part, raw, iterations))
            except (SimulationDiverged, UnstableStep):
                if raw is start:
                    raise
        self.partial_simulations += part.simulations if part is not self.objective else 0
        return multistart.select_best(part.problem(), ends)

    def _unfinished_reason(self, method: str) -> str:
        if self.reached_paper_threshold:
            return "stopped by the paper's rule, Chamfer below 1.5 cm"
        if method in CHAMFER_METHODS:
            return "gradient descent has no test of convergence"
        done = len(self.history) - 1
        return f"stopped after {done} iterations before converging"


def _has_unknown_bench(objective: Objective) -> bool:
    """Whether there are unknown errors of a bench that act on the cloth."""
    return any(nuisance.acts_on_cloth for nuisance in objective.nuisances)
