"""Inverse kinematics along a sequence of poses: damped least squares inside the soft limits, verified by forward."""

from __future__ import annotations

import torch
from torch import Tensor

from torchcloth._utils.torch_modes import disable_autocast
from torchcloth.errors import InvalidInput

from .chain import SerialChain
from .rigid import twist

MAX_JOINT_STEP = 0.3  # rad or m per iteration; the Jacobian is not valid for larger steps
RANDOM_RESTARTS = 20  # random postures for the first pose of a sequence; later poses must stay on its branch
RESTARTS_PER_BATCH = 4  # restarts that are computed together
RANK_TOLERANCE = 1e-4  # of the largest singular value; directions below it count as the null space
RESTART_SEED = 0  # the same poses give the same joints
LIMIT_DISTANCE = 1e-3  # rad or m, a joint that is nearer to a limit is at it


class UnreachablePose(InvalidInput):
    """The error for a pose without joint positions.

    Attributes:
        pose_index: its index in the sequence.
    """

    pose_index = 0


@disable_autocast()
@torch.no_grad()
def solve_inverse_kinematics(
    chain: SerialChain, poses: Tensor, q0: Tensor, reference: Tensor, tolerance: float, iterations: int
) -> list[Tensor | UnreachablePose]:
    """Return joint positions ``[K, J]`` for each of B paths, or the error of its first unreachable pose.

    Each pose starts from the solution of the one before it, the first one from ``q0``. Paths are computed together and
    do not depend on each other.

    Args:
        chain: the kinematics.
        poses: ``[B, K, 4, 4]`` m, in the world.
        q0: ``[B, J]`` where to start.
        reference: ``[B, J]`` the posture that spare degrees of freedom are drawn to.
        tolerance: the largest error accepted, position (m) and rotation (rad) in one norm.
        iterations: the largest number of steps for one pose.
    """
    limit = _soft_limits(chain)
    solved = q0[:, None].expand(*poses.shape[:2], -1).clone()
    failures: dict[int, UnreachablePose] = {}
    active, q = torch.arange(len(poses), device=q0.device), q0
    for index in range(poses.shape[1]):
        target, drawn_to = poses[active, index], reference[active]
        q, error = _approach(chain, target, q, drawn_to, limit, tolerance, iterations)
        unsolved = (~(error < tolerance)).nonzero()[:, 0]
        for starts in _random_postures(q0[0], limit).split(RESTARTS_PER_BATCH) if index == 0 else ():
            if not len(unsolved):
                break
            restarted, restart_error = _restart(
                chain, target[unsolved], starts, drawn_to[unsolved], limit, tolerance, iterations
            )
            closer = restart_error < error[unsolved]
            q[unsolved[closer]], error[unsolved[closer]] = restarted[closer], restart_error[closer]
            unsolved = (~(error < tolerance)).nonzero()[:, 0]
        for k in unsolved.tolist():
            failures[int(active[k])] = _unreached(chain, index, target[k], q[k], limit)
        reached = error < tolerance
        active, q = active[reached], q[reached]
        solved[active, index] = q
        if not len(active):
            break
    return [failures.get(k, joints) for k, joints in enumerate(solved)]


@torch.no_grad()
def bound_reach(chain: SerialChain, q: Tensor) -> tuple[Tensor, float]:
    """Return a fixed point of the first axis (the shoulder) and a bound of the chain's reach from it.

    Args:
        chain: the kinematics.
        q: ``[J]``, any posture.

    Returns:
        ``[3]`` m, and the length of the links laid in a line [m]; infinite for a chain with a prismatic joint.
    """
    bodies = chain.body_poses(q)
    poses = torch.cat([bodies[1:], chain.end_pose(bodies)[None]])
    origins = poses[:, :3, 3]
    axis = poses[0, :3, :3] @ chain.axis[0]
    shoulder = origins[0] + axis * (axis @ (origins[1] - origins[0]))
    links = torch.cat([shoulder[None], origins[1:]])
    if "prismatic" in chain.joint_types:
        return shoulder, torch.inf
    return shoulder, float(links.diff(dim=0).norm(dim=-1).sum())


def _soft_limits(chain: SerialChain) -> Tensor:
    limits = chain.limits
    return torch.stack([limits.soft_lower, limits.soft_upper])


def _approach(
    chain: SerialChain, target: Tensor, q: Tensor, reference: Tensor, limit: Tensor, tolerance: float, iterations: int
) -> tuple[Tensor, Tensor]:
    """Postures ``[N, J]`` reached from ``q [N, J]``, and their remaining errors ``[N]`` (m and rad in one norm)."""
    q = q.clamp(*limit)
    remaining_error = torch.empty_like(q[:, 0])
    active = torch.arange(len(q), device=q.device)
    for steps_left in range(iterations, -1, -1):
        bodies = chain.body_poses(q[active])
        error = twist(chain.end_pose(bodies), target[active])
        remaining_error[active] = error.norm(dim=-1)
        far = remaining_error[active] >= tolerance
        active = active[far]
        if not steps_left or not len(active):
            break
        step = _step(chain.end_jacobian(bodies[far]), error[far], q[active], reference[active], limit)
        longest = step.abs().amax(-1, keepdim=True)
        q[active] = (q[active] + step * (MAX_JOINT_STEP / longest.clamp(min=MAX_JOINT_STEP))).clamp(*limit)
    return q, remaining_error


def _restart(
    chain: SerialChain,
    target: Tensor,
    starts: Tensor,
    reference: Tensor,
    limit: Tensor,
    tolerance: float,
    iterations: int,
) -> tuple[Tensor, Tensor]:
    """Result of ``_approach`` from the first of the starts ``[S, J]`` that reaches the target, or from the best one."""
    n, starts_per_target = len(target), len(starts)
    target, reference = (x.repeat_interleave(starts_per_target, 0) for x in (target, reference))
    q, error = _approach(chain, target, starts.repeat(n, 1), reference, limit, tolerance, iterations)
    q, error = q.unflatten(0, (n, starts_per_target)), error.unflatten(0, (n, starts_per_target))
    reached = error < tolerance
    best = torch.where(reached.any(1), reached.int().argmax(1), error.argmin(1))
    index = torch.arange(n, device=best.device)
    return q[index, best], error[index, best]


def _step(jacobian: Tensor, error: Tensor, q: Tensor, reference: Tensor, limit: Tensor) -> Tensor:
    """One damped step ``[N, J]`` without the joints that would leave their range.

    The damping is half the squared error (Sugihara 2011): robust far from the target, Newton's method close to it. The
    pull to the reference lies in the null space. It fades with the error, so the posture depends on the path and not on
    how finely the path is sampled.
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
        moving = (right @ drawn[..., None])[..., 0] * (s > RANK_TOLERANCE * s[:, :1])
        step[todo] = drawn + free[todo] * ((wanted - moving)[:, None] @ right)[:, 0]
        blocked = ((q <= limit[0]) & (step < 0)) | ((q >= limit[1]) & (step > 0))
        todo = blocked.any(-1).nonzero()[:, 0]
        if not len(todo):
            break
        free = free * ~blocked
        step = step * free
    return step


def _random_postures(q0: Tensor, limit: Tensor) -> Tensor:
    """Starting points ``[RANDOM_RESTARTS, J]`` inside the limits; a joint without limits turns within +- pi."""
    generator = torch.Generator().manual_seed(RESTART_SEED)
    lower, upper = limit.clamp(-torch.pi, torch.pi)
    draws = torch.rand(RANDOM_RESTARTS, len(q0), generator=generator, dtype=torch.float64).to(q0)
    return lower + draws * (upper - lower)


def _unreached(chain: SerialChain, index: int, target: Tensor, q: Tensor, limit: Tensor) -> UnreachablePose:
    error = twist(chain.end_pose(chain.body_poses(q)), target)
    is_at_limit = ((q - limit[0]).abs() < LIMIT_DISTANCE) | ((q - limit[1]).abs() < LIMIT_DISTANCE)
    joints_at_limit = [name for name, at_limit in zip(chain.joint_names, is_at_limit.tolist(), strict=True) if at_limit]
    cause = (
        f"at its soft limit: {', '.join(joints_at_limit)}"
        if joints_at_limit
        else "no joint is at a limit: it is out of reach"
    )
    unreachable = UnreachablePose(
        f"pose {index} cannot be reached by {chain.name!r} ({cause})",
        got=f"{float(error[:3].norm()):.3g} m and {float(error[3:].norm()):.3g} rad left",
        remedy="move the pose, choose another q0, or add poses on the way to it",
    )
    unreachable.pose_index = index
    return unreachable
