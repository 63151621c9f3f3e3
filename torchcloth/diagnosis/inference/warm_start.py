"""Search for a start point at which slopes are valid, from the data sheet.

A data sheet may be wrong by a factor, and a sheet of cloth that is half as stiff folds elsewhere. Slopes at the data
sheet then lead anywhere. So residuals are first described by a parabola along every coordinate, as wide as its prior,

    r(u) = r + J u + Q u^2,

and its minimum is searched for within that width and the coordinate's bounds. The next sweep has half the width.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ...episodes.steps import shift_model
from ...episodes.world import WorldModel
from ...episodes.world_cache import IMPOSSIBLE_WORLD_ERRORS, none_if_impossible
from ...identification.estimators.box_qp import solve_box_qp
from ..data.dataset import DiagnosisData, Progress
from ..decide.criteria import CRITERIA
from .fitting import prior_precision
from .linearise import Linearisation, linearise
from .noise import inflated_noise, whiten
from .robust_weights import reweight

MAX_DAMPING = 1e6  # of the Gauss-Newton minimisation of a parabola


def quadratic_warm_start(
    model: WorldModel, data: DiagnosisData, progress: Progress = lambda _: None
) -> tuple[WorldModel, Linearisation]:
    """Search for a model near the optimum by parabolas along each coordinate.

    Args:
        model: at the data sheet.
        data: the episodes.
        progress: called with one line for each episode that is simulated.

    Returns:
        The model near the optimum, and a linearisation whose slopes along nuisances may be used from there on.
    """
    criteria = CRITERIA.warm_start
    widths = [p.prior_std for p in model.parameters]
    widths += [criteria.amplitude_width * abs(h.typical) for h in model.accepted]
    widths = [_shrink_to_possible(model, k, width) for k, width in enumerate(widths)]
    width, before = torch.tensor(widths, dtype=torch.float64), None
    prior = prior_precision(model).sqrt()
    for _ in range(criteria.sweeps):
        result, width = _linearise_both_sides(model, data, progress, before, width)
        before = before or result
        whitened = reweight(whiten(result, inflated_noise()))
        up, down = whitened.jacobian.chunk(2, dim=1)
        low, high = ((bound - model.point) / width for bound in model.bounds)
        slope, curvature = _fit_parabola(up * width, down * width, high.clamp(max=1.0), -low.clamp(min=-1.0))
        bounds = low.clamp(min=-criteria.max_step_widths), high.clamp(max=criteria.max_step_widths)
        u = _minimise_parabola(whitened.value, slope, curvature, model.point * prior, width * prior, bounds)
        model = model.at_point(model.point + u * width)
        if float(u.abs().max()) < criteria.converged_widths:
            break
        width = torch.where(u.abs() > criteria.keep_width_above, width, 0.5 * width)
    return model, before  # type: ignore[return-value]


def _linearise_both_sides(
    model: WorldModel, data: DiagnosisData, progress: Progress, before: Linearisation | None, width: Tensor
) -> tuple[Linearisation, Tensor]:
    """Return slopes a width to either side of every coordinate, and the width, halved until it can be simulated."""

    def try_width() -> Linearisation:
        shifts = [(k, sign * w) for sign in (1.0, -1.0) for k, w in enumerate(width.tolist())]
        return linearise(model, data, (), progress, before, shifts)

    for _ in range(CRITERIA.warm_start.max_halvings):
        try:
            return try_width(), width
        except IMPOSSIBLE_WORLD_ERRORS:
            width = 0.5 * width
    return try_width(), width


def _shrink_to_possible(model: WorldModel, coordinate: int, width: float) -> float:
    """Halve the width until there is a world on either side."""
    for _ in range(CRITERIA.warm_start.max_halvings):
        sides = [shift_model(model, coordinate, sign * width) for sign in (1.0, -1.0)]
        if all(none_if_impossible(side.build_world) for side in sides):
            break
        width *= 0.5
    return width


def _fit_parabola(up: Tensor, down: Tensor, forward: Tensor, backward: Tensor) -> tuple[Tensor, Tensor]:
    """Return (J, Q) [B, P] from difference quotients over forward and backward steps [P]; Q is 0 if one step is."""
    curvature = torch.where((forward > 0) & (backward > 0), (up - down) / (forward + backward), 0.0)
    return torch.where(forward > 0, up - curvature * forward, down), curvature


def _minimise_parabola(
    value: Tensor,
    slope: Tensor,
    curvature: Tensor,
    prior_offset: Tensor,
    prior_slope: Tensor,
    bounds: tuple[Tensor, Tensor],
    iterations: int = 50,
) -> Tensor:
    """Return [P] argmin |value + slope u + curvature u^2|^2 + |prior_offset + prior_slope u|^2 within bounds."""
    count = slope.shape[1]
    triangle = torch.linalg.qr(torch.cat([value[:, None], slope, curvature], 1)).R
    value, slope, curvature = triangle[:, 0], triangle[:, 1 : count + 1], triangle[:, count + 1 :]

    def residual(u: Tensor) -> Tensor:
        return torch.cat([value + slope @ u + curvature @ (u * u), prior_offset + prior_slope * u])

    u, damping = torch.zeros(count, dtype=value.dtype), 1e-3
    for _ in range(iterations):
        r, jacobian = residual(u), torch.cat([slope + 2 * curvature * u, torch.diag(prior_slope)])
        square = jacobian.mT @ jacobian
        damped = square + damping * torch.diag(square.diagonal())
        next_u = u + solve_box_qp(damped, -(jacobian.mT @ r), *(bound - u for bound in bounds))
        is_better = float(residual(next_u).norm()) < float(r.norm())
        u, damping = (next_u, 0.3 * damping) if is_better else (u, 10 * damping)
        if damping > MAX_DAMPING:
            break
    return u
