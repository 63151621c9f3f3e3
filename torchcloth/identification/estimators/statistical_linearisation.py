"""Slopes where the motion is chaotic: by regression over simulations around a point, not by tangents.

Light cloth that buckles forgets small differences: a change by a thousandth of its stiffness, and half a second later
its ripples lie elsewhere. Tangents describe that exactly and grow without bound (some 10 to 100 times in 0.3 s), while
the ripples themselves stay millimetres high. What a parameter does to the cloth as a whole is seen over finite steps,
beyond the ripples. So simulations are spread around the point, as wide as the answer is uncertain; the straight line
through their residuals is the slope (statistical linearisation, as in iterative ensemble smoothers: Chen and Oliver
2013), and their scatter about it is what ripples contribute, which the measured cloth has as well: noise by which rows
are weighted, and by which the errors are widened.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ...errors import SimulationDiverged, UnstableStep
from ..residuals.metrics import noise_scale
from ..uncertainty.consider_covariance import covariance_of, with_held_places
from ..uncertainty.identifiability import Reach
from . import levenberg_marquardt
from .levenberg_marquardt import Iterate, Linearised
from .linearity import Checked
from .objective import Objective
from .predictability import Within

ROUNDS = 8
WIDE, NARROW = 0.4, 0.2  # of a longest step: standard deviations of the simulations around a point
REACHED = 1.5  # of those a round may move at most
NEAR = 2.5  # of those within which simulations of earlier rounds count
SETTLED = 0.5  # standard errors of a step that ends the search
WORSE, HALVINGS = 1.25, 4  # a step that makes the distance larger by more is halved, at most so often
SEEN = 1.5  # mean square of a slope over that of its errors, from which it is one
SHARP = 1e-6  # least variance of a combination that the beginning told, in units of each unknown's own
SPARE = 4  # pairs of simulations beyond those that the slopes need


class Sample(NamedTuple):
    """One simulation."""

    raw: Tensor  # [K]
    value: Tensor  # [R], residuals
    x: Tensor  # [F, V, 3] m, frames of all episodes
    force: Tensor  # [F, 3] N, of all grippers


class Line(NamedTuple):
    """What runs straight through a cloud, and the scatter about it, in rows of equal noise."""

    linear: Linearised
    scatter: Tensor  # [N, R], of each simulation
    freedom: int


class Settled(NamedTuple):
    """Where the search ended."""

    final: Iterate
    reach: Reach
    covariance: Tensor  # [K, K]
    simulations: int


def resolved(
    objective: Objective,
    failed: Checked,
    known: Within | None,
    rounds: int,
    on_round: Callable[[Tensor], object],
    strata: Tensor | None = None,
) -> Checked | None:
    """All frames by simulations spread around the solution; None where they cannot be had.

    Args:
        objective: of all frames.
        failed: what tangents made of them.
        known: what the beginning told; it becomes the prior of what the other frames tell.
        rounds: at most so many.
        on_round: called with every point the search comes to.
        strata: as of ``covariance_of``.
    """
    before, problem = objective.simulations, objective.problem()
    raw, mask, note = failed.final.raw, None, ""
    if known is not None:
        told, mask = known.checked.final.raw, later(objective, known.objective)
        problem = _after(problem, told, covariance_of(known.objective, known.checked, strata))
        raw = _nearer(objective, told, raw)
        note = f" after the first {known.until:.2f} s"
    try:
        found = _settle(Around(objective, mask), problem, raw, rounds, on_round)
    except SimulationDiverged:
        return None
    objective.simulations = before + found.simulations
    warning = (
        f"{failed.reason}: slopes and errors{note} were taken from {found.simulations} simulations around the "
        "solution, and what moves the cloth less than its ripples do is not identifiable"
    )
    return Checked(found.final, found.reach, [warning], [], covariance=found.covariance)


def _after(problem: levenberg_marquardt.Problem, told: Tensor, covariance: Tensor) -> levenberg_marquardt.Problem:
    """With what is known already as the prior: of two unknowns that only their sum is known of, as that."""
    own = covariance.diagonal().sqrt()
    std = torch.minimum(own, problem.prior_std)
    values, vectors = torch.linalg.eigh(covariance / own[:, None] / own)
    inverse = (vectors / values.clamp(min=SHARP)) @ vectors.mT
    return problem._replace(prior_mean=told, prior_std=std, correlated=inverse / std[:, None] / std)


def _nearer(objective: Objective, told: Tensor, raw: Tensor) -> Tensor:
    """Where the beginning ended, unless the end of tangents lies nearer to all frames: they may have gone far alone."""
    try:
        return raw if objective.distance(raw) < objective.distance(told) else told
    except (SimulationDiverged, UnstableStep):
        return raw


def later(objective: Objective, part: Objective) -> Callable[[Linearised], Tensor]:
    """Which rows of the whole belong to no frame of its beginning."""

    def mask(linear: Linearised) -> Tensor:
        episode = objective.episode_of(linear)
        length = torch.tensor([len(e.times) + levenberg_marquardt.WINDOW for e in objective.episodes])
        seen = torch.tensor([e.observed for e in part.episodes])
        return linear.frame - (length.cumsum(0) - length)[episode] >= seen[episode]

    return mask


def _settle(
    around: Around,
    problem: levenberg_marquardt.Problem,
    start: Tensor,
    rounds: int,
    on_round: Callable[[Tensor], object],
) -> Settled:
    """Gauss-Newton on slopes by regression, from ``start`` [K].

    Raises:
        SimulationDiverged: too few simulations around a point go well.
    """
    objective, raw = around.objective, problem.clip(start)
    widest = WIDE * problem.longest
    spread = torch.minimum(torch.maximum(problem.prior_std, NARROW * problem.longest), widest)
    left = min(ROUNDS, max(1, rounds))
    while True:
        around.add(raw, spread)
        near, left = around.near(raw, spread), left - 1
        found = line(near, raw, around.rows)
        at = _seen_only(problem, levenberg_marquardt.judged(problem, raw, found.linear))
        gradient, hessian = levenberg_marquardt.normal_equations(problem, at)
        step = torch.linalg.solve(hessian, -gradient).clamp(-REACHED * spread, REACHED * spread)
        moved = _downhill(objective, problem, raw, step)
        ripples = _by_ripples(problem, at, found)
        covariance = levenberg_marquardt.at_least(levenberg_marquardt.covariance(problem, at), ripples.diagonal())
        deviation, fabric = covariance.diagonal().sqrt(), len(objective.unknowns)
        small = bool(((moved - raw).abs() <= SETTLED * deviation)[:fabric].all())
        on_round(moved)
        if small or not left:
            linear = at.linear._replace(value=at.linear.value + at.linear.jacobian @ (moved - raw))
            final = levenberg_marquardt.judged(problem, moved, linear)._replace(converged=small)
            made = len(around.samples) * len(objective.episodes)
            return Settled(final, _reach(objective, near, raw), covariance, made)
        raw, spread = moved, torch.minimum(torch.maximum(deviation, NARROW * problem.longest), widest)


def _seen_only(problem: levenberg_marquardt.Problem, at: Iterate) -> Iterate:
    """Without slopes that are no larger than their own errors: those of unknowns that ripples hide."""
    weight, linear = at.influence()[0], at.linear
    if linear.wobble is None or linear.blur is None:
        return at
    size = weight @ linear.jacobian.square()
    error = (weight * linear.wobble).sum() * linear.blur.diagonal()
    jacobian = torch.where(size > SEEN * error, linear.jacobian, 0.0)
    return levenberg_marquardt.judged(problem, at.raw, linear._replace(jacobian=jacobian))


def _downhill(objective: Objective, problem: levenberg_marquardt.Problem, raw: Tensor, step: Tensor) -> Tensor:
    """As far along a step as the cloth does not come to lie farther off than ripples put it."""
    now = objective.distance(raw)
    for _ in range(HALVINGS):
        moved = problem.clip(raw + step)
        try:
            if not objective.distance(moved) > WORSE * now:
                return moved
        except (SimulationDiverged, UnstableStep):
            pass
        step = 0.5 * step
    return raw


class Around:
    """Makes simulations around points of an objective, and keeps them.

    Offsets of held places that are not fitted are drawn by their noise: they scatter, as what is not known does.
    """

    def __init__(self, objective: Objective, mask: Callable[[Linearised], Tensor] | None) -> None:
        self.objective, self.mask = objective, mask
        self.wider, self.drawn = with_held_places(objective)
        self.samples: list[Sample] = []
        self.fresh = 0  # number of the first one of this round
        self.rows: Linearised  # what rows mean, from the first simulation on

    def add(self, raw: Tensor, spread: Tensor) -> None:
        """Pairs on both sides of ``raw`` [K]; ``spread`` [K]: their standard deviations."""
        count, self.fresh = len(raw), len(self.samples)
        for offset in _offsets(count, int(self.drawn.sum()), len(self.samples)):
            near = self.objective.clip(raw + spread * offset[:count])
            point = self.wider.start.clone()
            point[~self.drawn], point[self.drawn] = near, offset[count:] * self.wider.prior_std[self.drawn]
            try:
                self.rows, seen = self.wider.evaluate_all(point), self.wider.seen(point)
            except (SimulationDiverged, UnstableStep):
                continue
            forces = [w[1:, :3] for frames in seen for w in frames.wrench.values()]
            force = torch.cat(forces) if forces else raw.new_zeros(0, 3)
            value = self.rows.value if self.mask is None else self.rows.value * self.mask(self.rows)
            self.samples.append(Sample(near, value, torch.cat([frames.x for frames in seen]), force))

    def near(self, raw: Tensor, spread: Tensor) -> list[Sample]:
        """Those that count at a point.

        Raises:
            SimulationDiverged: too few.
        """
        earlier = [s for s in self.samples[: self.fresh] if bool(((s.raw - raw).abs() <= NEAR * spread).all())]
        found = [*earlier, *self.samples[self.fresh :]]  # of many unknowns some always lie far out in one
        if len(found) < len(raw) + SPARE:
            raise SimulationDiverged(
                f"only {len(found)} simulations around the solution went well",
                remedy="start nearer, or with a smaller dt",
            )
        return found


def line(near: Sequence[Sample], raw: Tensor, like: Linearised) -> Line:
    """By least squares about ``raw``; rows are divided by their noise, that of the ripples and of the data."""
    design, value = _design(near, raw), torch.stack([s.value for s in near])
    solved = torch.linalg.lstsq(design, value).solution
    scatter = value - design @ solved
    freedom = len(design) - design.shape[1]
    wobble = _pooled(scatter.square().sum(0) / freedom, like)
    weight = _weight(solved[0], wobble, like.kind)
    inverse = torch.linalg.inv(design.mT @ design)[1:, 1:]
    linear = like._replace(
        value=weight * solved[0], jacobian=weight[:, None] * solved[1:].mT, wobble=weight**2 * wobble, blur=inverse
    )
    return Line(linear, weight * scatter, freedom)


def _weight(data: Tensor, wobble: Tensor, kind: Tensor) -> Tensor:
    """[R], so that rows of a kind have equal noise; in its mean it stays as it is."""
    weight = torch.ones_like(data)
    for b in kind.unique():
        own = (kind == b) & (data != 0)
        if int(own.sum()) > 1:
            calm = wobble[own] <= wobble[own].median()  # what ripples leave alone shows the sensor's noise
            floor = noise_scale(data[own][calm], None) ** 2
            noise = (floor + wobble[own]).sqrt()
            weight[own] = noise.square().mean().sqrt() / noise
    return weight


def _offsets(count: int, beside: int, seed: int) -> Tensor:
    """[N, K + others] in standard deviations: pairs, and columns that are orthogonal among the unknowns."""
    pairs = count + SPARE
    draw = torch.randn(pairs, count + beside, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    straight = torch.linalg.qr(draw[:, :count])[0] * pairs**0.5
    half = torch.cat([straight, draw[:, count:]], 1)
    return torch.cat([half, -half])


def _design(near: Sequence[Sample], raw: Tensor) -> Tensor:
    moved = torch.stack([s.raw for s in near]) - raw
    return torch.cat([torch.ones(len(moved), 1, dtype=moved.dtype), moved], 1)


def _pooled(variance: Tensor, like: Linearised) -> Tensor:
    """[R], means over rows of one kind, frame and patch: each alone is known to little better than a factor of two."""
    patches = int(like.patch.max()) + 1
    group = (like.kind * (int(like.frame.max()) + 1) + like.frame) * patches + like.patch
    total, count = variance.new_zeros(2, int(group.max()) + 1).index_add(
        1, group, torch.stack([variance, torch.ones_like(variance)])
    )
    return (total / count.clamp(min=1))[group]


def _by_ripples(problem: levenberg_marquardt.Problem, at: Iterate, found: Line) -> Tensor:
    """[K, K]: the measured cloth ripples as one more simulation does; so much each of them moves the estimate."""
    inverse = torch.linalg.inv(levenberg_marquardt.information(problem, at))
    moved = found.scatter @ (at.influence()[0][:, None] * at.linear.jacobian) @ inverse
    student = levenberg_marquardt.student(found.freedom) / levenberg_marquardt.NORMAL
    return student**2 * moved.mT @ moved / found.freedom + inverse @ problem.precision @ inverse


def _reach(objective: Objective, near: Sequence[Sample], raw: Tensor) -> Reach:
    """By regression of the frames and of the forces, less what ripples alone would show."""
    design, count = _design(near, raw), len(objective.unknowns)
    error = torch.linalg.pinv(design.mT @ design).diagonal()[1 : count + 1]

    def size(parts: list[Tensor]) -> Tensor:
        many = torch.stack(parts).to(design).flatten(1)
        if not many.shape[1]:  # no gripper was felt
            return many.new_zeros(count)
        found = torch.linalg.lstsq(design, many).solution
        slope = found[1 : count + 1].unflatten(1, (-1, 3)).square().sum(-1).mean(1)
        ripples = 3 * (many - design @ found).square().sum(0).mean() / (len(design) - design.shape[1])
        return torch.where(slope > SEEN * error * ripples, slope - error * ripples, 0.0).sqrt()

    return Reach(size([s.x for s in near]), size([s.force for s in near]))
