"""How long a motion can be predicted: the frames over which derivatives hold.

Light cloth that buckles forgets small differences: its tangents grow some tenfold in a third of a second, for ever,
while the ripples that differ stay millimetres high. Before that the motion is as regular as any other, and the data
tell as much as the tangents say. So where the whole does not pass the test of ``linearity``, the longest beginning is
sought that does.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from torch import Tensor

from ...errors import SimulationDiverged, UnstableStep
from . import levenberg_marquardt
from .linearity import Checked, check, runaway
from .objective import Objective

SHARES = (0.1, 0.15, 0.22, 0.33, 0.5, 0.75)  # of the frames, one after the other
HALVINGS = 2
ITERATIONS = 20
NEAR, EXACT = 1.0, 0.1  # standard errors of a step that ends a search: while the beginning grows, and of the longest


class Within(NamedTuple):
    """A solution on the beginning of the episodes."""

    objective: Objective  # of those frames
    checked: Checked
    until: float  # s, of the motion


OnIterate = Callable[[levenberg_marquardt.Iterate, Objective], bool]


def within(objective: Objective, failed: Checked, start: Tensor, on_iterate: OnIterate) -> Within | None:
    """The solution on the longest beginning that can be predicted; None where there is none.

    The beginning grows, and each solution is where the next search starts: from a wrong start the later ripples are
    wrong as well, and lead nowhere.

    Args:
        objective: of all frames.
        failed: what became of them.
        start: [K].
        on_iterate: called with (iterate, objective) at every point; returns True to stop.
    """
    best, high = None, 1.0
    for share in SHARES:
        found = _solved(objective, share, start if best is None else best[1].final.raw, on_iterate, NEAR)
        if found is not None:
            best, low = found, share
        elif best is not None:
            high = share
            break
    if best is None:
        return None
    for _ in range(HALVINGS):
        share = 0.5 * (low + high)
        found = _solved(objective, share, best[1].final.raw, on_iterate, NEAR)
        low, high, best = (low, share, best) if found is None else (share, high, found)
    near = best[0], best[1]._replace(final=best[1].final._replace(converged=False))
    return _told(objective, failed, *(_solved(objective, low, best[1].final.raw, on_iterate, EXACT) or near))


def _solved(
    objective: Objective, share: float, start: Tensor, on_iterate: OnIterate, tolerance: float
) -> tuple[Objective, Checked] | None:
    """On a share of the frames; None where derivatives do not hold."""
    part = objective.part(share)
    if not part.told:
        return None
    try:
        final = levenberg_marquardt.minimise(
            part.problem(), start, ITERATIONS, lambda it: on_iterate(it, part), tolerance
        )
        checked = None if runaway(part, final) else check(part, final)
    except (SimulationDiverged, UnstableStep):
        checked = None
    objective.simulations += part.simulations
    return None if checked is None or checked.withdrawn else (part, checked)


def _told(objective: Objective, failed: Checked, part: Objective, checked: Checked) -> Within:
    frames, count = (max(e.observed for e in o.episodes) for o in (part, objective))
    until = max(float(e.times[e.observed - 1] - e.times[0]) for e in part.episodes)
    warning = (
        f"{failed.reason}: derivatives hold for the first {until:.2f} s only, and only those frames, "
        f"{frames} of {count}, were used"
    )
    return Within(part, checked._replace(warnings=[warning]), until)
