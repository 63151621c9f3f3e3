"""Choice of the experiment that best distinguishes causes, or shows one that is not detectable yet.

With the information V on causes that is left beyond everything that is fitted anyway,

    D_ij = a_i^2 V_ii (1 - rho_ij^2 - h)

is the chi-squared that distinguishes cause i at amplitude a_i from cause j at its best amplitude, beyond the fraction h
by which two simulators may differ (``CandidateCriteria.simulator_tolerance``). An experiment adds its own slopes, as
the present model has them, to those of the data (T-optimal design, linearised: Chen and Asprey 2003). Its noise is that
of a correct model, in which ripples carry little information. The experiment whose smallest D over the pairs is largest
is proposed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...episodes.observed import Episode, build_episode
from ...episodes.replay import Frames
from ...episodes.steps import central_steps
from ...episodes.world_cache import WorldCache
from ...errors import InvalidInput, TorchclothError
from ...recordings import Recording
from ..data.binning import bin_residuals, concatenate_directions, finite_differences
from ..data.dataset import DiagnosisData, Progress, drop_unsimulated_frames, extend_for_clock
from ..decide.criteria import CRITERIA
from ..decide.search import SearchResult
from ..inference.episode_simulation import differentiate_nuisances, map_parallel, run_episode
from ..inference.fitting import ModelFit, prior_precision
from ..inference.lack_of_fit import reference_noise
from ..inference.linearise import central_differences
from ..inference.noise import Noise
from .feasibility import FeasibleExperiment, check_feasibility
from .motions import Experiment

DEFAULT_POINTS_PER_FRAME = 250  # if the data have no points
DEFAULT_POINT_NOISE_M = 1e-3  # if the data do not state it


@dataclass(frozen=True)
class OpenQuestion:
    """Question that an experiment should answer.

    Attributes:
        fitted: a model with slopes along all the causes.
        amplitudes: amplitude of each cause by name.
        pairs: pairs of causes to distinguish; empty: each cause is to be detected at all.
    """

    fitted: ModelFit
    amplitudes: Mapping[str, float]
    pairs: tuple[tuple[str, str], ...] = ()

    @cached_property
    def worlds(self) -> WorldCache:
        """Worlds of the model and of shifted points, for all experiments."""
        return WorldCache(self.fitted.model, central_steps(self.fitted.model))


class Proposal(NamedTuple):
    """The most informative experiment.

    Attributes:
        content: ``next_experiment`` of diagnosis.json.
        episode: the experiment as an episode without measurements.
    """

    content: dict[str, Any]
    episode: Recording


def propose_experiment(
    result: SearchResult, content: Mapping[str, Any], data: DiagnosisData, progress: Progress
) -> Proposal | None:
    """Propose the most informative experiment that the arms can do.

    Args:
        result: the search.
        content: the content of diagnosis.json so far.
        data: the episodes.
        progress: called with one line for each experiment.

    Returns:
        The proposal; None if nothing is open, or if no experiment informs about it.
    """
    question = find_open_question(result, content)
    if question is None:
        return None
    names = list(question.amplitudes)
    now = compute_chi2(question, compute_information(question, []))

    def simulate(item: tuple[int, FeasibleExperiment]) -> tuple[FeasibleExperiment, Tensor] | None:
        k, choice = item
        progress(f"{choice.experiment}, {k + 1} of {len(possible)}")
        try:
            return choice, simulate_whitened_slopes(question, replace(choice.episode, joints={}), data)
        except (TorchclothError, torch.linalg.LinAlgError):  # pyright: ignore[reportPrivateImportUsage]
            return None  # an experiment that cannot be simulated says nothing

    choices = check_feasibility(data.recordings, progress)
    if content.get("single_motion"):  # a repetition would leave a single motion
        choices = [choice for choice in choices if str(choice.experiment) not in data.motions]
    refused = {str(c.experiment): c.why_not for c in choices if c.why_not is not None}
    possible = [c for c in choices if not c.why_not]
    answers = map_parallel(simulate, list(enumerate(possible)))
    simulated = [answer for answer in answers if answer is not None]
    if not simulated:
        return None
    chi2 = [compute_chi2(question, compute_information(question, [slopes])) for _, slopes in simulated]
    order = sorted(range(len(simulated)), key=lambda k: _rate(chi2[k], question))
    best, median = max(range(len(simulated)), key=lambda k: _rate(chi2[k], question)), order[len(order) // 2]
    if max(chi2[best].values()) <= 0:
        return None
    choice, slopes = simulated[best]
    experiment = choice.experiment
    repetitions = _count_repetitions(question, slopes)
    description = {
        "motion": experiment.motion,
        "heading": experiment.heading,
        "speed": experiment.speed,
        "separates": [list(pair) for pair in question.pairs],
        "detects": [] if question.pairs else names,
        "expected_chi2": min(chi2[best].values()),
        "current_chi2": min(now.values()),
        "median": {
            "experiment": str(simulated[median][0].experiment),
            "expected_chi2": min(chi2[median].values()),
        },
        "repetitions": repetitions,
        "arms": _describe_arms(choice, refused),
        "why": _explain(experiment, question, now, chi2[best], min(chi2[median].values()), repetitions),
    }
    return Proposal(description, choice.episode)


def _describe_arms(choice: FeasibleExperiment, refused: Mapping[str, str]) -> dict[str, Any] | None:
    """Return what the arms can do; None if the episodes name none."""
    if choice.plan is not None:
        return {"slowdown": choice.plan.slowdown, "limited_by": choice.plan.limiting_joint, "refused": refused}
    return None if choice.not_checked is None else {"not_checked": choice.not_checked}


def find_open_question(result: SearchResult, content: Mapping[str, Any]) -> OpenQuestion | None:
    """Return what a search leaves open: causes with rivals, else hypotheses that are not decided.

    Of a single motion, it is which of the hypotheses that would explain it does.

    Args:
        result: the search.
        content: descriptions of causes and of what is too small to be relevant, which may have relevant rivals; of a
            single motion, the ranking ``in_sample``.
    """
    descriptions = [*content["causes"], *content["minor"]]
    parameters = {p.name for p in result.end.model.parameters}  # no experiment shows what equals one of them
    for cause, description in zip([*result.causes, *result.minor], descriptions, strict=True):
        hypotheses = cause.fit_before.linearisation.hypotheses
        known = {h.name for h in hypotheses if h.equivalent_parameter not in parameters}
        candidates = known & {description["effect"], *(r["effect"] for r in description["rivals"])}
        amplitudes = {h.name: a for h, a in result.equivalents(cause) if h.name in candidates}
        by_score = {s.hypothesis.name: s.amplitude for s in cause.scores if not s.has_wrong_sign}
        confounded = known & by_score.keys() & set(description.get("equivalence_class", ()))
        amplitudes |= {name: by_score[name] for name in sorted(confounded - amplitudes.keys())}
        signed = {h.name for h in hypotheses if h.signed}
        amplitudes = {name: a for name, a in amplitudes.items() if name in signed or a >= 0}
        best = cause.candidate.hypothesis.name
        pairs = tuple((best, other) for other in amplitudes if other != best)
        if best in amplitudes and pairs:
            return OpenQuestion(cause.fit_before, amplitudes, pairs)
    if result.causes:
        return None
    hypotheses = result.end.linearisation.hypotheses
    known = {h.name for h in hypotheses if h.equivalent_parameter not in parameters}
    explanations = [row for row in content.get("in_sample", ()) if row["effect"] in known]
    if explanations:
        return _distinguish_explanations(result, explanations)
    undecided = [s for s in result.scores if s.decision in ("present", "inconclusive") and s.hypothesis.name in known]
    undecided = undecided[: CRITERIA.proposal.max_undecided]
    amplitudes = {s.hypothesis.name: s.hypothesis.smallest_of_interest for s in undecided}
    return OpenQuestion(result.end, amplitudes) if amplitudes else None


def _distinguish_explanations(result: SearchResult, rows: Sequence[Mapping[str, Any]]) -> OpenQuestion:
    """Return which of the explanations of a single motion holds, or whether the only one does."""
    rows = rows[: CRITERIA.proposal.max_undecided]
    best, *others = (row["effect"] for row in rows)
    same = next(h for h in result.end.linearisation.hypotheses if h.name == best).structurally_equivalent
    pairs = tuple((best, other) for other in others if other not in same)
    return OpenQuestion(result.end, {row["effect"]: row["amplitude"] for row in rows}, pairs)


def compute_information(question: OpenQuestion, added: Sequence[Tensor]) -> Tensor:
    """Return [causes, causes] the information beyond what is fitted anyway.

    Args:
        question: the causes, and the data.
        added: whitened slopes of added experiments.
    """
    fitted, n = question.fitted, question.fitted.linearisation.n_coordinates
    columns = [*range(n), *(n + k for k in _list_columns(question))]
    slopes = fitted.whitened.jacobian[:, columns]
    square = slopes.mT @ slopes + sum(other.mT @ other for other in added)
    square[range(n), range(n)] += prior_precision(fitted.model)
    compensation = torch.linalg.solve(square[:n, :n], square[:n, n:])
    return square[n:, n:] - square[n:, :n] @ compensation


def compute_chi2(question: OpenQuestion, information: Tensor) -> dict[tuple[str, ...], float]:
    """Return D of every pair, the smaller way round; of every cause alone if there are no pairs.

    Args:
        question: the causes.
        information: [causes, causes] as ``compute_information`` returns it.
    """
    index = {name: k for k, name in enumerate(question.amplitudes)}
    alone = {
        name: a * a * float(information[k, k])
        for (name, a), k in zip(question.amplitudes.items(), index.values(), strict=True)
    }
    if not question.pairs:
        return {(name,): d for name, d in alone.items()}
    chi2, tolerance = {}, CRITERIA.candidate.simulator_tolerance
    for a, b in question.pairs:
        i, j = index[a], index[b]
        square = float(information[i, j] ** 2 / (information[i, i] * information[j, j]).clamp(min=1e-30))
        chi2[(a, b)] = min(alone[a], alone[b]) * max(1 - square - tolerance, 0.0)
    return chi2


def simulate_whitened_slopes(question: OpenQuestion, recording: Recording, data: DiagnosisData) -> Tensor:
    """Simulate the whitened slopes of an experiment that has not been done, by the present model on the coarse mesh.

    Causes have the amplitudes that were found: what wind implies brakes whichever way the wind blows.

    Args:
        question: the causes.
        recording: the experiment.
        data: the episodes, for the number of points.

    Returns:
        [B, coordinates + causes] slopes.

    Raises:
        InvalidInput: a cause with which the experiment cannot be simulated.
    """
    fitted, model = question.fitted, question.fitted.model
    hypotheses = [
        replace(h, typical=question.amplitudes[h.name] or h.typical)
        for h in (fitted.linearisation.hypotheses[k] for k in _list_columns(question))
    ]
    world, shifts = question.worlds.base, question.worlds.shifts
    blank = extend_for_clock(build_episode(model.base.cloth, recording))
    runs = run_episode(question.worlds, blank, data.dt, hypotheses, with_grasp_shifts=True)
    with_hypotheses = [frames for frames in runs.with_hypotheses if frames is not None]
    if len(with_hypotheses) < len(hypotheses):
        raise InvalidInput("experiment", got="a cause that it cannot be simulated with", expected="another experiment")
    base = runs.plain
    observed = simulate_measurements(base, blank, data)
    steps = [*(step for _, step in shifts), *(h.typical for h in hypotheses)]
    derivatives = finite_differences(base, [*runs.shifted, *with_hypotheses], steps)
    nuisances, std = differentiate_nuisances(world, base, runs.grasp_shifted, observed)
    derivatives = concatenate_directions(derivatives, nuisances)
    bins = bin_residuals(base, derivatives, observed, data.surface, data.rest_positions)
    bins = central_differences(bins, shifts, len(model.parameters))
    count = len(model.point) + len(hypotheses)
    reference, _ = reference_noise(bins, torch.zeros_like(bins.value))
    noise = Noise(torch.maximum(reference.levels, fitted.noise.levels), fitted.noise.depth_level)
    factor = torch.linalg.cholesky(noise.covariance(bins, bins.jacobian[:, count:], std))
    return torch.linalg.solve_triangular(factor, bins.jacobian[:, :count], upper=False)


def simulate_measurements(frames: Frames, blank: Episode, data: DiagnosisData, seed: int = 0) -> Episode:
    """Return the episode with simulated points and forces, as many and as noisy as in the data.

    Args:
        frames: the simulation.
        blank: the episode without measurements.
        data: the episodes.
        seed: of the points, which are uniform over the surface, and of their noise.
    """
    generator = torch.Generator().manual_seed(seed)
    counts = sorted(len(c) for e in data.episodes for c in e.clouds if len(c))
    n_points = counts[len(counts) // 2] if counts else DEFAULT_POINTS_PER_FRAME
    faces, noise_std = data.surface.faces, blank.noise_std or DEFAULT_POINT_NOISE_M
    corners = data.rest_positions[faces]
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=-1)
    clouds = []
    for x in frames.x:
        face = faces[torch.multinomial(area, n_points, replacement=True, generator=generator)]
        weight = -torch.rand(n_points, 3, generator=generator).log()
        weight = (weight / weight.sum(1, keepdim=True)).to(x)
        points = (weight[..., None] * x[face]).sum(1)
        clouds.append(points + noise_std * torch.randn(n_points, 3, generator=generator).to(x))
    wrenches = {}
    for name, measured in blank.wrenches.items():
        is_measured = measured.isfinite().any(0)  # a force may be measured without a torque, or the other way round
        wrenches[name] = torch.where(is_measured, frames.wrench[name], measured)
    return drop_unsimulated_frames(replace(blank, clouds=clouds, wrenches=wrenches))


def _list_columns(question: OpenQuestion) -> list[int]:
    index = {h.name: k for k, h in enumerate(question.fitted.linearisation.hypotheses)}
    return [index[name] for name in question.amplitudes]


def _rate(chi2: Mapping[tuple[str, ...], float], question: OpenQuestion) -> tuple[float, float]:
    """Rate an experiment by its weakest pair, or by how many single causes it detects; then by all together.

    A single cause that no experiment detects must not decide.
    """
    total = sum(math.log1p(d) for d in chi2.values())
    if question.pairs:
        return min(chi2.values()), total
    return sum(min(d / CRITERIA.proposal.min_chi2, 1.0) for d in chi2.values()), total


def _count_repetitions(question: OpenQuestion, slopes: Tensor) -> int | None:
    """Return how often an experiment must be done; None: more often than is proposed."""
    for n in range(1, CRITERIA.proposal.max_repetitions + 1):
        chi2 = compute_chi2(question, compute_information(question, [slopes] * n))
        if min(chi2.values()) >= CRITERIA.proposal.min_chi2:
            return n
    return None


def _explain(
    experiment: Experiment,
    question: OpenQuestion,
    now: Mapping[tuple[str, ...], float],
    chi2: Mapping[tuple[str, ...], float],
    median: float,
    repetitions: int | None,
) -> str:
    criteria = CRITERIA.proposal
    hardest = min(chi2, key=lambda key: chi2[key])
    if question.pairs:
        what = f"{hardest[0]} is hardest to distinguish from {hardest[1]}"
    else:
        what = f"{hardest[0]} is hardest to detect"
    often = {None: f"even {criteria.max_repetitions} repetitions do not suffice", 1: "once is enough"}.get(
        repetitions, f"{repetitions} repetitions"
    )
    return (
        f"{experiment}: {what}, by chi^2 = {now[hardest]:.2g} now and {chi2[hardest]:.2g} with it "
        f"({criteria.min_chi2:.1f} is needed; {often}). Half of all possible motions give less than {median:.2g}."
    )
