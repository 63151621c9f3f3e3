"""From a data sheet to where slopes hold.

A data sheet may be wrong by a factor, and a sheet of cloth that is half as stiff folds elsewhere: slopes at the start
point anywhere. So residuals are first described by a parabola along every coordinate, as wide as its prior,

    r(u) = r + J u + Q u^2,

whose minimum is looked for within that width and the ends of every coordinate. Then the same with half the width.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ...episodes.steps import shifted
from ...episodes.world import Model
from ...episodes.world_cache import IMPOSSIBLE, if_possible
from ...identification.estimators.box_qp import bounded
from ..data.dataset import Progress, DiagnosisData
from .fitting import prior_precision
from .linearise import Linearisation, linearise
from .noise import inflated_noise, whiten
from .robust_weights import reweight

SWEEPS = 2
FARTHEST = 1.2  # widths, of one sweep
HALVINGS = 4  # of a width without a world
THERE = 0.25  # widths, from which on slopes do


def quadratic_warm_start(model: Model, setting: DiagnosisData, progress: Progress = lambda _: None) -> tuple[Model, Linearisation]:
    """(a model near the optimum, evidence whose nuisances' slopes may be used from there on)."""
    wide = [*(p.std for p in model.parameters), *(0.5 * abs(h.typical) for h in model.accepted)]
    wide = [_possible(model, k, width) for k, width in enumerate(wide)]
    width, before = torch.tensor(wide, dtype=torch.float64), None
    prior = prior_precision(model).sqrt()
    for _ in range(SWEEPS):
        evidence, width = _on_either_side(model, setting, progress, before, width)
        before = before or evidence
        white = reweight(whiten(evidence, inflated_noise()))
        up, down = white.jacobian.chunk(2, dim=1)
        low, high = ((end - model.point) / width for end in model.ends)
        slope, bend = _parabola(up * width, down * width, high.clamp(max=1.0), -low.clamp(min=-1.0))
        reach = low.clamp(min=-FARTHEST), high.clamp(max=FARTHEST)
        u = _lowest(white.value, slope, bend, model.point * prior, width * prior, reach)
        model = model.at(model.point + u * width)
        if float(u.abs().max()) < THERE:
            break
        width = torch.where(u.abs() > 0.8, width, 0.5 * width)
    return model, before  # type: ignore[return-value]


def _on_either_side(
    model: Model, setting: DiagnosisData, progress: Progress, before: Linearisation | None, width: Tensor
) -> tuple[Linearisation, Tensor]:
    """Evidence a width on either side of every coordinate, or as much of it as can be simulated; (it, the width)."""

    def gathered() -> Linearisation:
        shifts = [(k, sign * w) for sign in (1.0, -1.0) for k, w in enumerate(width.tolist())]
        return linearise(model, setting, (), progress, before, shifts)

    for _ in range(HALVINGS):
        try:
            return gathered(), width
        except IMPOSSIBLE:
            width = 0.5 * width
    return gathered(), width


def _possible(model: Model, coordinate: int, width: float) -> float:
    """The width, or as much of it as has a world on either side."""
    for _ in range(HALVINGS):
        if all(if_possible(shifted(model, coordinate, sign * width).world) for sign in (1.0, -1.0)):
            break
        width *= 0.5
    return width


def _parabola(up: Tensor, down: Tensor, ahead: Tensor, back: Tensor) -> tuple[Tensor, Tensor]:
    """(J, Q) [C, P] from difference quotients over steps [P] of ``ahead`` and ``back``; straight, where one is none."""
    bend = torch.where((ahead > 0) & (back > 0), (up - down) / (ahead + back), 0.0)
    return torch.where(ahead > 0, up - bend * ahead, down), bend


def _lowest(
    value: Tensor,
    slope: Tensor,
    bend: Tensor,
    start: Tensor,
    pull: Tensor,
    reach: tuple[Tensor, Tensor],
    iterations: int = 50,
) -> Tensor:
    """[P] minimum of |value + slope u + bend u^2|^2 + |start + pull u|^2 within reach, by damped Gauss-Newton."""
    count = slope.shape[1]
    triangle = torch.linalg.qr(torch.cat([value[:, None], slope, bend], 1)).R
    value, slope, bend = triangle[:, 0], triangle[:, 1 : count + 1], triangle[:, count + 1 :]
    rest = lambda u: torch.cat([value + slope @ u + bend @ (u * u), start + pull * u])  # noqa: E731
    u, damping = torch.zeros(count, dtype=value.dtype), 1e-3
    for _ in range(iterations):
        r, j = rest(u), torch.cat([slope + 2 * bend * u, torch.diag(pull)])
        square = j.mT @ j
        damped = square + damping * torch.diag(square.diagonal())
        tried = u + bounded(damped, -(j.mT @ r), *(end - u for end in reach))
        better = float(rest(tried).norm()) < float(r.norm())
        u, damping = (tried, 0.3 * damping) if better else (u, 10 * damping)
        if damping > 1e6:
            break
    return u
