"""Which experiment would tell causes apart, or show one that cannot be seen yet.

With V the information on causes that is left beside everything that is fitted anyway,

    D_ij = a_i^2 V_ii (1 - rho_ij^2 - h)

is the chi^2 by which cause i at amplitude a_i is told from j at its best amplitude, beyond the share h by which two
engines may differ (``trials.HARDLY``). An experiment adds its own slopes, as the present model has them, to those of
the data (T-optimal design, linearised: Chen and Asprey 2003), as noisy as a right model would be there: ripples tell
little. Of all experiments the one is proposed whose smallest D over the pairs is largest.
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
from ...episodes.steps import both_ways
from ...episodes.world_cache import Worlds
from ...errors import InvalidInput, TorchclothError
from ...recordings import Recording
from ..data.binning import bin_residuals, finite_differences, concatenate_directions
from ..data.dataset import Progress, DiagnosisData, extend_for_clock, drop_unsimulated_frames
from ..decide.candidates import HARDLY
from ..decide.search import SearchResult
from ..inference.episode_simulation import differentiate_nuisances, run_episode, map_parallel
from ..inference.fitting import ModelFit, prior_precision
from ..inference.lack_of_fit import reference_noise
from ..inference.linearise import central_differences
from ..inference.noise import Noise
from .feasibility import Choice, feasible
from .motions import Experiment

NEEDED = (1.64 + 0.84) ** 2  # chi^2: told apart in 80 % of cases at 5 %
MOST_REPEATS = 10
MANY = 6  # causes that cannot be decided yet, the likeliest
POINTS = 250  # of a frame, where the data do not say


@dataclass(frozen=True)
class Question:
    """What is to be told.

    Attributes:
        fitted: a model with slopes along all the causes.
        amplitudes: of the causes by name.
        pairs: of causes to be told apart; none: each is to be seen at all.
    """

    fitted: ModelFit
    amplitudes: Mapping[str, float]
    pairs: tuple[tuple[str, str], ...] = ()

    @cached_property
    def worlds(self) -> Worlds:
        """Of the model and beside it, for all experiments."""
        return Worlds(self.fitted.model, both_ways(self.fitted.model))


class Proposal(NamedTuple):
    """An experiment that tells most."""

    content: dict[str, Any]  # ``next_experiment`` of diagnosis.json
    episode: Recording  # it, with blanks for what will be seen and felt


def propose(found: SearchResult, content: Mapping[str, Any], setting: DiagnosisData, progress: Progress) -> Proposal | None:
    """Of what the arms can do, the experiment that tells most; None: nothing is open, or nothing tells of it."""
    question = question_of(found, content)
    if question is None:
        return None
    names = list(question.amplitudes)
    now = distances(question, information(question, []))

    def ask(choice: Choice) -> tuple[Choice, Tensor] | None:
        progress(str(choice.experiment))
        try:
            return choice, whitened_slopes(question, replace(choice.episode, joints={}), setting)
        except (TorchclothError, torch.linalg.LinAlgError):  # pyright: ignore[reportPrivateImportUsage]
            return None  # it cannot be simulated, so it says nothing

    choices = feasible(setting.recordings, progress)
    refused = {str(c.experiment): c.why_not for c in choices if c.why_not is not None}
    tried = [answer for answer in map_parallel(ask, [c for c in choices if not c.why_not]) if answer is not None]
    if not tried:
        return None
    told = [distances(question, information(question, [slopes])) for _, slopes in tried]
    best = max(range(len(tried)), key=lambda k: _worth(told[k], question))
    if max(told[best].values()) <= 0:
        return None
    middle = sorted(range(len(tried)), key=lambda k: _worth(told[k], question))[len(tried) // 2]
    choice, slopes = tried[best]
    experiment = choice.experiment
    repeats = _repeats(question, slopes)
    said = {
        "motion": experiment.motion,
        "heading": experiment.heading,
        "speed": experiment.speed,
        "separates": [list(pair) for pair in question.pairs],
        "shows": [] if question.pairs else names,
        "expected_d": _weakest(told[best]),
        "d_now": _weakest(now),
        "median": {"experiment": str(tried[middle][0].experiment), "expected_d": _weakest(told[middle])},
        "repeats": repeats,
        "arms": _arms(choice, refused),
        "why": _why(experiment, question, now, told[best], _weakest(told[middle]), repeats),
    }
    return Proposal(said, choice.episode)


def _arms(choice: Choice, refused: Mapping[str, str]) -> dict[str, Any] | None:
    """What the arms make of it; None where none are named."""
    if choice.plan is not None:
        return {"slower": choice.plan.slowdown, "limit": choice.plan.limiting_joint, "refused": refused}
    return None if choice.unasked is None else {"unasked": choice.unasked}


def question_of(found: SearchResult, content: Mapping[str, Any]) -> Question | None:
    """What a search leaves open: causes that have rivals, else causes that are not decided.

    ``content`` holds what was said of causes, and of what is too small to matter: that may have rivals that would.
    """
    said = [*content["causes"], *content["minor"]]
    fitted = {p.name for p in found.end.model.parameters}  # what does the same as one of them, no experiment shows
    for step, cause in zip([*found.causes, *found.minor], said, strict=True):
        known = {h.name for h in step.fit_before.linearisation.hypotheses if h.equivalent_parameter not in fitted}
        open_to = known & {cause["effect"], *(r["effect"] for r in cause["rivals"])}
        amplitudes = {h.name: a for h, a in found.equivalents(step) if h.name in open_to}
        rows = {r.hypothesis.name: r.amplitude for r in step.scores if not r.has_wrong_sign}
        more = known & rows.keys() & set(cause.get("class", ()))
        amplitudes |= {name: rows[name] for name in sorted(more - amplitudes.keys())}
        signed = {h.name for h in step.fit_before.linearisation.hypotheses if h.signed}
        amplitudes = {name: a for name, a in amplitudes.items() if name in signed or a >= 0}
        best = step.candidate.hypothesis.name
        pairs = tuple((best, other) for other in amplitudes if other != best)
        if best in amplitudes and pairs:
            return Question(step.fit_before, amplitudes, pairs)
    if found.causes:
        return None
    known = {h.name for h in found.end.linearisation.hypotheses if h.equivalent_parameter not in fitted}
    open_rows = [r for r in found.scores if r.decision in ("present", "inconclusive") and r.hypothesis.name in known]
    amplitudes = {r.hypothesis.name: r.hypothesis.smallest for r in open_rows[:MANY]}
    return Question(found.end, amplitudes) if amplitudes else None


def information(question: Question, added: Sequence[Tensor]) -> Tensor:
    """[causes, causes] that is left beside what is fitted anyway, of the data and of added experiments."""
    found, own = question.fitted, question.fitted.linearisation.n_coordinates
    columns = [*range(own), *(own + k for k in _columns(question))]
    data = found.whitened.jacobian[:, columns]
    square = data.mT @ data + sum(slopes.mT @ slopes for slopes in added)
    square[range(own), range(own)] += prior_precision(found.model)
    beside = torch.linalg.solve(square[:own, :own], square[:own, own:])
    return square[own:, own:] - square[own:, :own] @ beside


def distances(question: Question, left: Tensor) -> dict[tuple[str, ...], float]:
    """D of every pair, the smaller way round; of every cause alone where there are no pairs."""
    index = {name: k for k, name in enumerate(question.amplitudes)}
    alone = {
        name: a * a * float(left[k, k])
        for (name, a), k in zip(question.amplitudes.items(), index.values(), strict=True)
    }
    if not question.pairs:
        return {(name,): d for name, d in alone.items()}
    out = {}
    for a, b in question.pairs:
        i, j = index[a], index[b]
        alike = float(left[i, j] ** 2 / (left[i, i] * left[j, j]).clamp(min=1e-30))
        out[(a, b)] = min(alone[a], alone[b]) * max(1 - alike - HARDLY, 0.0)
    return out


def whitened_slopes(question: Question, recording: Recording, setting: DiagnosisData) -> Tensor:
    """[C, own + causes] of an experiment that has not been done, by the present model on the coarser mesh.

    Along causes as large as they were found: what wind brings along brakes whichever way that blows.
    """
    found, model = question.fitted, question.fitted.model
    asked = [found.linearisation.hypotheses[k] for k in _columns(question)]
    hypotheses = [replace(h, typical=question.amplitudes[h.name] or h.typical) for h in asked]
    world, shifts = question.worlds.plain, question.worlds.shifts
    blank = extend_for_clock(build_episode(model.base.cloth, recording))
    done = run_episode(question.worlds, blank, setting.dt, hypotheses, with_grasp_shifts=True)
    trials = [t for t in done.with_hypotheses if t is not None]
    if len(trials) < len(hypotheses):
        raise InvalidInput("experiment", got="a cause that it cannot be simulated with", expected="another experiment")
    base = done.plain
    seen = as_seen(base, blank, setting)
    moved = finite_differences(base, [*done.shifted, *trials], [*(s for _, s in shifts), *(h.typical for h in hypotheses)])
    other, std = differentiate_nuisances(world, base, done.grasp_shifted, seen)
    cells = bin_residuals(base, concatenate_directions(moved, other), seen, setting.sheet, setting.rest_positions)
    cells = central_differences(cells, shifts, len(model.parameters))
    count = len(model.point) + len(hypotheses)
    level, _ = reference_noise(cells, torch.zeros_like(cells.value))
    noise = Noise(torch.maximum(level.levels, found.noise.levels), found.noise.depth_level)
    root = torch.linalg.cholesky(noise.covariance(cells, cells.jacobian[:, count:], std))
    return torch.linalg.solve_triangular(root, cells.jacobian[:, :count], upper=False)


def as_seen(frames: Frames, blank: Episode, setting: DiagnosisData, seed: int = 0) -> Episode:
    """The episode with points as many and as noisy as in the data, evenly over the surface, and felt forces."""
    rng = torch.Generator().manual_seed(seed)
    counts = sorted(len(c) for e in setting.episodes for c in e.clouds if len(c))
    many = counts[len(counts) // 2] if counts else POINTS
    faces, noise = setting.sheet.faces, blank.noise_std or 1e-3
    corners = setting.rest_positions[faces]
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=-1)
    clouds = []
    for x in frames.x:
        face = faces[torch.multinomial(area, many, replacement=True, generator=rng)]
        weight = -torch.rand(many, 3, generator=rng).log()
        weight = (weight / weight.sum(1, keepdim=True)).to(x)
        on = (weight[..., None] * x[face]).sum(1)
        clouds.append(on + noise * torch.randn(many, 3, generator=rng).to(x))
    felt = lambda w: w.isfinite().any(0)  # noqa: E731 - a force without a torque, or the other way round
    wrenches = {name: torch.where(felt(w), frames.wrench[name], w) for name, w in blank.wrenches.items()}
    return drop_unsimulated_frames(replace(blank, clouds=clouds, wrenches=wrenches))


def _columns(question: Question) -> list[int]:
    index = {h.name: k for k, h in enumerate(question.fitted.linearisation.hypotheses)}
    return [index[name] for name in question.amplitudes]


def _weakest(told: Mapping[tuple[str, ...], float]) -> float:
    return min(told.values())


def _worth(told: Mapping[tuple[str, ...], float], question: Question) -> tuple[float, float]:
    """Of pairs the weakest, then all; of single causes how many are seen, since one that never is must not decide."""
    every = sum(math.log1p(d) for d in told.values())
    return (_weakest(told) if question.pairs else sum(min(d / NEEDED, 1.0) for d in told.values()), every)


def _repeats(question: Question, slopes: Tensor) -> int | None:
    """How often it must be done; None: more than can be asked."""
    for n in range(1, MOST_REPEATS + 1):
        told = distances(question, information(question, [slopes] * n))
        if _weakest(told) >= NEEDED:
            return n
    return None


def _why(
    experiment: Experiment,
    question: Question,
    now: Mapping[tuple[str, ...], float],
    told: Mapping[tuple[str, ...], float],
    median: float,
    repeats: int | None,
) -> str:
    hardest = min(told, key=lambda key: told[key])
    if question.pairs:
        about = f"{hardest[0]} is hardest to tell from {hardest[1]}"
    else:
        about = f"{hardest[0]} is hardest to see"
    times = {None: f"even {MOST_REPEATS} repetitions would not do", 1: "once is enough"}.get(
        repeats, f"{repeats} repetitions"
    )
    return (
        f"{experiment}: {about}, by chi^2 = {now[hardest]:.2g} now and {told[hardest]:.2g} with it "
        f"({NEEDED:.1f} is needed; {times}). Half of all motions that can be asked for give less than {median:.2g}."
    )
