"""Inverse kinematics along a sequence of poses: damped least squares inside the soft limits, verified by forward."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchcloth._utils.torch_modes import undisturbed
from torchcloth.errors import InvalidInput

from .rigid import twist

if TYPE_CHECKING:
    from .arm import Arm

LARGEST_STEP = 0.3  # rad or m in one iteration: the Jacobian is trusted no further
RESTARTS = 20  # random postures for the first pose of a sequence; later poses must stay on its branch
AT_ONCE = 4  # of these, side by side
RANK = 1e-4  # singular values smaller than this share of the largest move nothing
SEED = 0  # the same poses give the same joints


class Unreachable(InvalidInput):
    """A pose that no joint positions were found for; ``pose`` is its index."""

    pose = 0


@undisturbed()
@torch.no_grad()
def solve(
    arm: Arm, poses: Tensor, q0: Tensor, reference: Tensor, tolerance: float, iterations: int
) -> list[Tensor | Unreachable]:
    """For each of the paths ``poses [B, K, 4, 4]`` joint positions ``[K, J]``, or its first pose without any.

    Each pose is started from the one before, the first from ``q0 [B, J]``. Paths go on side by side and know nothing of
    each other.
    """
    limit = arm._limits[2:4]
    solved = q0[:, None].expand(*poses.shape[:2], -1).clone()
    lost: dict[int, Unreachable] = {}
    going, q = torch.arange(len(poses), device=q0.device), q0
    for index in range(poses.shape[1]):
        target, drawn_to = poses[going, index], reference[going]
        q, error = _approach(arm, target, q, drawn_to, limit, tolerance, iterations)
        astray = (~(error < tolerance)).nonzero()[:, 0]
        for starts in _random_postures(q0[0], limit).split(AT_ONCE) if index == 0 else ():
            if not len(astray):
                break
            again = _from_elsewhere(arm, target[astray], starts, drawn_to[astray], limit, tolerance, iterations)
            closer = again[1] < error[astray]
            q[astray[closer]], error[astray[closer]] = again[0][closer], again[1][closer]
            astray = (~(error < tolerance)).nonzero()[:, 0]
        for k in astray.tolist():
            lost[int(going[k])] = _unreached(arm, index, target[k], q[k], limit)
        kept = error < tolerance
        going, q = going[kept], q[kept]
        solved[going, index] = q
        if not len(going):
            break
    return [lost.get(k, joints) for k, joints in enumerate(solved)]


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
) -> tuple[Tensor, Tensor]:
    """Postures ``[N, J]`` reached from ``q [N, J]``, and what is left of their errors ``[N]`` (m, rad in one norm)."""
    q = q.clamp(*limit)
    left = torch.empty_like(q[:, 0])
    going = torch.arange(len(q), device=q.device)
    for remaining in range(iterations, -1, -1):
        bodies = arm._bodies(q[going])
        error = twist(arm._tips(bodies), target[going])
        left[going] = error.norm(dim=-1)
        far = left[going] >= tolerance
        going = going[far]
        if not remaining or not len(going):
            break
        step = _step(arm._jacobian(bodies[far]), error[far], q[going], reference[going], limit)
        longest = step.abs().amax(-1, keepdim=True)
        q[going] = (q[going] + step * (LARGEST_STEP / longest.clamp(min=LARGEST_STEP))).clamp(*limit)
    return q, left


def _from_elsewhere(
    arm: Arm, target: Tensor, starts: Tensor, reference: Tensor, limit: Tensor, tolerance: float, iterations: int
) -> tuple[Tensor, Tensor]:
    """What ``_approach`` finds from the first of the starts ``[S, J]`` that leads there, or comes closest."""
    n, each = len(target), len(starts)
    target, reference = (x.repeat_interleave(each, 0) for x in (target, reference))
    q, error = _approach(arm, target, starts.repeat(n, 1), reference, limit, tolerance, iterations)
    q, error = q.unflatten(0, (n, each)), error.unflatten(0, (n, each))
    reached = error < tolerance
    best = torch.where(reached.any(1), reached.int().argmax(1), error.argmin(1))
    every = torch.arange(n, device=best.device)
    return q[every, best], error[every, best]


def _step(jacobian: Tensor, error: Tensor, q: Tensor, reference: Tensor, limit: Tensor) -> Tensor:
    """One damped step ``[N, J]`` that leaves out the joints which would leave their range.

    The damping is half the squared error (Sugihara 2011): robust from afar, Newton's method close by. The pull to the
    reference lies in the null space and fades with the error too, so the posture depends on the path and not on how
    finely it is cut.
    """
    size = error.norm(dim=-1, keepdim=True)
    damping = 0.5 * size**2 + torch.finfo(q.dtype).eps
    pull = size.clamp(max=0.5) * (reference - q)
    free = torch.ones_like(q)
    step = torch.zeros_like(q)
    todo = torch.arange(len(q), device=q.device)
    for _ in range(q.shape[1]):
        left, s, right = torch.linalg.svd(jacobian[todo] * free[todo, None], full_matrices=False)
        wanted = s / (s**2 + damping[todo]) * (left.mT @ error[todo, :, None])[..., 0]
        drawn = free[todo] * pull[todo]
        moving = (right @ drawn[..., None])[..., 0] * (s > RANK * s[:, :1])
        step[todo] = drawn + free[todo] * ((wanted - moving)[:, None] @ right)[:, 0]
        blocked = ((q <= limit[0]) & (step < 0)) | ((q >= limit[1]) & (step > 0))
        todo = blocked.any(-1).nonzero()[:, 0]
        if not len(todo):
            break
        free = free * ~blocked
        step = step * free
    return step


def _random_postures(q0: Tensor, limit: Tensor) -> Tensor:
    """Starting points ``[RESTARTS, J]`` inside the limits; a joint without limits turns within +- pi."""
    generator = torch.Generator().manual_seed(SEED)
    lower, upper = limit.clamp(-torch.pi, torch.pi)
    draws = torch.rand(RESTARTS, len(q0), generator=generator, dtype=torch.float64).to(q0)
    return lower + draws * (upper - lower)


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
