"""Finite steps around a model's point, within the bounds of its coordinates."""

from __future__ import annotations

from .world import WorldModel


def list_steps(model: WorldModel) -> list[tuple[int, float]]:
    """Return (coordinate, small step) along each of the model's coordinates."""
    parameters = [p.step for p in model.parameters]
    return list(enumerate([*parameters, *(h.step_fraction * h.typical for h in model.accepted)]))


def central_steps(model: WorldModel) -> list[tuple[int, float]]:
    """Return (coordinate, step) forwards and backwards along each coordinate, without steps beyond its bounds.

    A coordinate along which both steps are beyond the bounds has the forward one, which ``clip_step`` shortens.
    """
    low, high = (bound.tolist() for bound in model.bounds)
    here = model.point.tolist()
    candidates = [(k, sign * step) for k, step in list_steps(model) for sign in (1.0, -1.0)]
    inside = [(k, step) for k, step in candidates if low[k] <= here[k] + step <= high[k]]
    covered = {k for k, _ in inside}
    clipped = [pair for pair in list_steps(model) if pair[0] not in covered]
    return sorted([*inside, *clipped], key=lambda pair: pair[0])


def one_sided_steps(model: WorldModel) -> list[tuple[int, float]]:
    """Return (coordinate, step) along each coordinate, backwards where the forward step is beyond a bound."""
    steps: dict[int, float] = {}
    for k, step in [*central_steps(model), *list_steps(model)]:
        steps.setdefault(k, step)
    return sorted(steps.items())


def shift_model(model: WorldModel, coordinate: int, step: float) -> WorldModel:
    """Return the model shifted by a step along one coordinate."""
    point = model.point
    point[coordinate] += step
    return model.at_point(point)


def clip_step(model: WorldModel, coordinate: int, step: float) -> float:
    """Return the step as far as the bounds allow; the step itself if they allow none, so that it can divide."""
    low, high = (float(bound[coordinate]) for bound in model.bounds)
    here = float(model.point[coordinate])
    shifted = min(max(here + step, low), high)
    return step if shifted == here + step else shifted - here or step
