"""Steps beside a model's point, within the ends of its coordinates."""

from __future__ import annotations

from .world import Model


def step_sizes(model: Model) -> list[tuple[int, float]]:
    """(coordinate, small step) along each of the model's own."""
    return list(enumerate([*(p.step for p in model.parameters), *(h.step * h.typical for h in model.accepted)]))


def both_ways(model: Model) -> list[tuple[int, float]]:
    """(coordinate, step) there and back along each of the model's own, but for what lies beyond its ends.

    One of which both lie beyond goes there, as far as it may (``taken``).
    """
    low, high = (end.tolist() for end in model.ends)
    here = model.point.tolist()
    every = [(k, sign * step) for k, step in step_sizes(model) for sign in (1.0, -1.0)]
    within = [(k, step) for k, step in every if low[k] <= here[k] + step <= high[k]]
    told = {k for k, _ in within}
    return sorted([*within, *(way for way in step_sizes(model) if way[0] not in told)], key=lambda way: way[0])


def one_way(model: Model) -> list[tuple[int, float]]:
    """(coordinate, step) along each of the model's own, back where there lies beyond an end."""
    ways: dict[int, float] = {}
    for k, step in [*both_ways(model), *step_sizes(model)]:
        ways.setdefault(k, step)
    return sorted(ways.items())


def shifted(model: Model, coordinate: int, step: float) -> Model:
    """Beside the model's point."""
    beside = model.point
    beside[coordinate] += step
    return model.at(beside)


def taken(model: Model, coordinate: int, step: float) -> float:
    """The step as far as the coordinate's ends allow; one of no length tells nothing, whatever it is divided by."""
    low, high = (float(end[coordinate]) for end in model.ends)
    here = float(model.point[coordinate])
    there = min(max(here + step, low), high)
    return step if there == here + step else there - here or step
