"""Inverse kinematics along a sequence of poses: damped least squares inside the soft limits, verified by forward."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchcloth.errors import InvalidInput

from .rigid import twist

if TYPE_CHECKING:
    from .arm import Arm

LARGEST_STEP = 0.3  # rad or m in one iteration: the Jacobian is trusted no further
RESTARTS = 20  # random postures for the first pose of a sequence; later poses must stay on its branch
SEED = 0  # the same poses give the same joints


class Unreachable(InvalidInput):
    """A pose that no joint positions were found for; ``pose`` is its index."""

    pose = 0


@torch.no_grad()
def solve(
    arm: Arm, poses: Tensor, q0: Tensor, reference: Tensor, limit: Tensor, tolerance: float, iterations: int
) -> Tensor:
    """Joint positions ``[K, J]`` for ``poses [K, 4, 4]``, each one started from the one before."""
    solved: list[Tensor] = []
    q = q0
    for index, target in enumerate(poses):
        tries = [q] if solved else [q, *_random_postures(q0, limit)]
        attempts = []
        for start in tries:
            attempts.append(_approach(arm, target, start, reference, limit, tolerance, iterations))
            if attempts[-1][1] < tolerance:
                break
        q, error = min(attempts, key=lambda attempt: attempt[1])
        if error >= tolerance:
            raise _unreached(arm, index, target, q, limit)
        solved.append(q)
    return torch.stack(solved)


@torch.no_grad()
def reach(arm: Arm) -> tuple[Tensor, float]:
    """The shoulder ``[3]`` m, a fixed point of the first axis, and a distance [m] from it that no pose exceeds.

    The bound is the length of the links laid in a line; infinite for an arm with a prismatic joint.
    """
    places = torch.cat([arm._bodies(arm.home)[1:], arm(arm.home)[None]])
    origins = places[:, :3, 3]
    axis = places[0, :3, :3] @ arm._axis[0]
    shoulder = origins[0] + axis * (axis @ (origins[1] - origins[0]))
    chain = torch.cat([shoulder[None], origins[1:]])
    if "prismatic" in arm.joint_types:
        return shoulder, torch.inf
    return shoulder, float(chain.diff(dim=0).norm(dim=-1).sum())


def _approach(
    arm: Arm, target: Tensor, q: Tensor, reference: Tensor, limit: Tensor, tolerance: float, iterations: int
) -> tuple[Tensor, float]:
    """The posture reached from ``q`` and what is left of its error (m and rad in one norm)."""
    q = q.clamp(*limit)
    for _ in range(iterations):
        error = twist(arm(q), target)
        if error.norm() < tolerance:
            break
        step = _step(arm.jacobian(q), error, q, reference, limit)
        q = (q + step * (LARGEST_STEP / step.abs().max().clamp(min=LARGEST_STEP))).clamp(*limit)
    return q, float(twist(arm(q), target).norm())


def _step(jacobian: Tensor, error: Tensor, q: Tensor, reference: Tensor, limit: Tensor) -> Tensor:
    """One damped step that leaves out the joints which would leave their range.

    The damping is half the squared error (Sugihara 2011): robust from afar, Newton's method close by. The pull to the
    reference lies in the null space and fades with the error too, so the posture depends on the path and not on how
    finely it is cut.
    """
    size = error.norm()
    damping = (0.5 * size**2 + torch.finfo(q.dtype).eps) * torch.eye(6, dtype=q.dtype, device=q.device)
    free = torch.ones_like(q)
    step = torch.zeros_like(q)
    for _ in range(len(q)):
        j = jacobian * free
        pull = free * size.clamp(max=0.5) * (reference - q)
        step = j.mT @ torch.linalg.solve(j @ j.mT + damping, error)
        step = step + pull - torch.linalg.pinv(j, rtol=1e-4) @ (j @ pull)
        blocked = ((q <= limit[0]) & (step < 0)) | ((q >= limit[1]) & (step > 0))
        if not bool(blocked.any()):
            break
        free = free * ~blocked
        step = step * free
    return step


def _random_postures(q0: Tensor, limit: Tensor) -> list[Tensor]:
    """Starting points inside the limits; a joint without limits turns within +- pi."""
    generator = torch.Generator().manual_seed(SEED)
    lower, upper = limit.clamp(-torch.pi, torch.pi)
    draws = torch.rand(RESTARTS, len(q0), generator=generator, dtype=torch.float64).to(q0)
    return list(lower + draws * (upper - lower))


def _unreached(arm: Arm, index: int, target: Tensor, q: Tensor, limit: Tensor) -> Unreachable:
    """The error for the first pose without a solution."""
    error = twist(arm(q), target)
    near = ((q - limit[0]).abs() < 1e-3) | ((q - limit[1]).abs() < 1e-3)
    stuck = [name for name, at_limit in zip(arm.joint_names, near.tolist(), strict=True) if at_limit]
    cause = f"at its soft limit: {', '.join(stuck)}" if stuck else "no joint is at a limit: it is out of reach"
    unreachable = Unreachable(
        f"pose {index} cannot be reached by {arm.name!r} ({cause})",
        got=f"{float(error[:3].norm()):.3g} m and {float(error[3:].norm()):.3g} rad left",
        remedy="move the pose, choose another q0, or add poses on the way to it",
    )
    unreachable.pose = index
    return unreachable
