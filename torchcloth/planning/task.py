"""What is sought: waypoints of all grippers after which the cloth, as the models have it, lies at the goal."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import torch
from torch import Tensor
from torch.func import jacfwd

from .._utils.resume import Journal
from ..robots.clearance import Gap  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation
from ..types import Trajectory
from .clearance import Clearance
from .forward_model import Rehearsal
from .goal import Goal
from .motion_parameters import Bounds, Course
from .objective import Pull, aim_at, mean

LEVER = 0.1  # m, at which a gripper's turns count as shifts
T = TypeVar("T", bound=Sequence)
STIFF = 1e-3  # m^2, of unknowns that move no gripper


class Task:
    """See ``descent.Problem``; all distances are means over the models.

    Args:
        rehearsals: of each model.
        courses: of the grippers; the unknowns are their waypoints [K, C], flat, one course after the other.
        goal: where the cloth shall be.
        clearance: what the arms must stay clear of; None: nothing is known.
        journal: keeps what was computed.
    """

    def __init__(
        self,
        rehearsals: Sequence[Rehearsal],
        courses: Sequence[Course],
        goal: Goal,
        clearance: Clearance | None,
        journal: Journal | None,
    ) -> None:
        self.rehearsals, self.courses, self.goal = rehearsals, courses, goal
        self.bounds, self._clearance, self._journal = Bounds.of(courses), clearance, journal
        self.aims = [aim_at(goal, r.mesh) for r in rehearsals]
        self.start = torch.cat([c.nothing.flatten() for c in courses])
        self.metric = self._metric()

    def motion(self, at: Tensor) -> dict[str, Trajectory]:
        """The poses by gripper, at unknowns [N]; differentiable."""
        return {c.name: c.trajectory(z) for c, z in zip(self.courses, self.split(at), strict=True)}

    def split(self, at: Tensor) -> list[Tensor]:
        """Waypoints [K, C] of each course."""
        shapes = [c.nothing.shape for c in self.courses]
        return [p.reshape(s) for p, s in zip(at.split([s.numel() for s in shapes]), shapes, strict=True)]

    @torch.no_grad()
    def look(self, at: Tensor) -> tuple[float, float]:
        """(distance [m], mean square distance [m^2])."""
        distance, square = self._ask("look", at, lambda: self._look(at))
        return float(distance), float(square)

    def pull(self, at: Tensor) -> Pull:
        """What the unknowns do to the mean square distance: by forward mode, in constant memory; float64."""
        return Pull(*(part.double() for part in self._ask("pull", at, lambda: self._pull(at))))

    def slope(self, at: Tensor) -> tuple[float, Tensor]:
        """(distance [m], its gradient [N]), by reverse mode."""
        distance, gradient = self._ask("slope", at, lambda: self._slope(at))
        return float(distance), gradient

    def clear(self, at: Tensor) -> bool:
        """Whether the arms are, where anything is known of that."""
        return self._clearance is None or self._clearance.nearest(self.angles(at))[1] is None

    def nearest(self, at: Tensor) -> Gap | None:
        """The smallest distance between solids on the way; None: nothing is known of that."""
        return None if self._clearance is None else self._clearance.nearest(self.angles(at))[0]

    def angles(self, at: Tensor) -> dict[str, Tensor]:
        """[N, J] rad, by arm, at the instants of ``Span``."""
        return {c.name: c.at_instants(z) for c, z in zip(self.courses, self.split(at), strict=True)}

    def each(self, at: Tensor) -> tuple[list[float], Tensor]:
        """(distance [m] of every model, [T, V, 3] m of the first one's cloth)."""
        with torch.no_grad():
            runs = [r.run(self.motion(at)) for r in self.rehearsals]
        return [float(aim.distance(x[-1])) for aim, x in zip(self.aims, runs, strict=True)], runs[0]

    def _ask(self, question: str, at: Tensor, work: Callable[[], T]) -> T:
        return work() if self._journal is None else self._journal.ask(question, at, work)

    def _look(self, at: Tensor) -> tuple[Tensor, Tensor]:
        motion = self.motion(at)
        ends = [(aim, r.run(motion)[-1]) for aim, r in zip(self.aims, self.rehearsals, strict=True)]
        distance = torch.stack([aim.distance(x) for aim, x in ends]).mean()
        return distance, torch.tensor([aim.square(x) for aim, x in ends]).mean()

    def _pull(self, at: Tensor) -> Pull:
        motion, moved = self.motion(at), self._moved(at)
        parts = []
        for aim, r in zip(self.aims, self.rehearsals, strict=True):
            parts.append(aim.pull(*r.last(motion, moved)))
        return mean(parts)

    def _slope(self, at: Tensor) -> tuple[Tensor, Tensor]:
        """One model after the other: the graph of one is all that is in memory at once."""
        values, gradient = [], torch.zeros_like(at)
        for aim, r in zip(self.aims, self.rehearsals, strict=True):
            with torch.enable_grad():
                free = at.clone().requires_grad_()
                distance = aim.distance(r.run(self.motion(free))[-1])
                gradient += torch.autograd.grad(distance, free)[0].to(gradient) / len(self.rehearsals)
            values.append(distance.detach())
        return torch.stack(values).mean(), gradient

    def _moved(self, at: Tensor) -> dict[str, Tensor]:
        """[N, S, 4, 4] by gripper: what each unknown does to its poses."""
        out, done, shapes = {}, 0, self.split(at)
        for course, z in zip(self.courses, shapes, strict=True):
            slopes = jacfwd(lambda w, c=course: c.trajectory(w).pose)(z)  # [S, 4, 4, K, C]
            own = slopes.flatten(3).movedim(3, 0)
            before, after = (own.new_zeros(n, *own.shape[1:]) for n in (done, len(at) - done - len(own)))
            out[course.name] = torch.cat([before, own, after])
            done += len(own)
        return out

    def _metric(self) -> Tensor:
        """[N, N] m^2, mean squares over time of how far the paths go, turns at ``LEVER``; at the recorded motion."""
        total = STIFF * torch.eye(len(self.start), dtype=torch.float64)
        for own in self._moved(self.start).values():
            shift, turn = own[:, :, :3, 3].flatten(1), LEVER * own[:, :, :3, :3].flatten(1)
            total = total + (shift @ shift.mT + 0.5 * turn @ turn.mT) / own.shape[1]
        return total
