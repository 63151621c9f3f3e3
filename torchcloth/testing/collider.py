"""The contract of colliders."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import torch
from torch import Tensor

from .._utils.linalg import cross, dot
from ..boundaries import AbstractCollider
from . import samples
from .boundary import BoundaryContract
from .contract import float64, require, require_close, require_finite_gradients


class ColliderContract(BoundaryContract):
    """What the layer relies on in a solid body. Override ``collider``; run it once fixed and once with ``moving``.

    Attributes:
        moving: the collider travels and turns during the trials.
        extent: the body lies within this distance of its origin [m].
        rounding: error of distances [m], rounding alone where they have closed forms.
        slant: error of normals against the gradient of the distance, rounding alone for closed forms.
        projections: number of steps along the normal that bring a point to the surface.
    """

    moving = False
    extent = 0.2
    rounding = 1e-12
    slant = 1e-9
    projections = 2  # more would gather points where two sides are equally near

    @abstractmethod
    def collider(self, **options: Any) -> AbstractCollider:
        """Make the collider with Coulomb friction > 0 and these options (``moving``, ``recovery``)."""

    def make(self) -> AbstractCollider:
        """Make the collider that the general promises test."""
        return self.collider(moving=self.moving)

    def _pose(self) -> Tensor | None:
        return self._travel() if self.moving else None

    def _body(self, **options: Any) -> AbstractCollider:
        with float64():
            return self.collider(**options).double()

    def _at(self, height: Tensor) -> tuple[Tensor, Tensor]:
        """(points [N, 3] about ``height`` [N, 1] m above the surface, all around, velocities [N, 3])."""
        body = self._body()
        p = 0.7 * self.extent * samples.normal((len(height), 3), 1)
        for _ in range(self.projections):
            distance, normal = (part.detach() for part in body.clearance(p))
            p = p - (distance - height) * normal
        return p, samples.normal(tuple(p.shape), 2)

    def sample(self) -> tuple[Tensor, Tensor]:
        """Draw states all around the surface: inside, arriving, leaving."""
        return self._at(0.001 * samples.normal((len(self.mesh().vertices), 1), 3))

    def rest(self) -> tuple[Tensor, Tensor]:
        """Return a state exactly on the surface, at rest."""
        x, _ = self._at(torch.zeros(len(self.mesh().vertices), 1, dtype=torch.float64))
        return x, torch.zeros_like(x)

    def _lattice(self) -> Tensor:
        """Points through and around the body, with the origin, axes and planes of symmetry."""
        steps = self.extent * torch.tensor([-5.0, -1.5, -0.6, 0.0, 0.3, 1.0, 2.0], dtype=torch.float64)
        return torch.cartesian_prod(steps, steps, steps)

    def test_the_normal_is_the_gradient_of_the_distance(self) -> None:
        """The normal is the distance's gradient, of unit length, near the surface inside and outside."""
        body = self._body()
        p = self._at(0.02 * self.extent * samples.normal((200, 1), 4))[0].requires_grad_()
        distance, normal = body.clearance(p)
        (slope,) = torch.autograd.grad(distance.sum(), p)
        require_close(dot(normal, normal), torch.ones_like(distance), 1e-12, "normals are not unit vectors")
        require_close(slope, normal, self.slant, "the normal is not the gradient of the distance")

    def test_the_distance_leads_to_the_surface(self) -> None:
        """Moving back along the normal by the distance ends at distance 0: it is in metres."""
        body = self._body()
        p, _ = self._at(0.02 * self.extent * samples.normal((200, 1), 4))
        distance, normal = body.clearance(p)
        left = float(body.clearance(p - distance * normal)[0].detach().abs().max())
        require(left <= self.rounding, f"the surface is missed by {left:.2e} m")

    def test_is_finite_everywhere(self) -> None:
        """Distances, normals and derivatives are finite at centres, axes, edges and far away."""
        body = self._body().requires_grad_()
        p = self._lattice().requires_grad_()
        distance, normal = body.clearance(p)
        require(torch.isfinite(distance).all() and torch.isfinite(normal).all(), "distance or normal is not finite")
        require_close(dot(normal, normal), torch.ones_like(distance), 1e-12, "normals are not unit vectors everywhere")
        leaves = {"p": p, **dict(body.named_parameters())}
        require_finite_gradients(torch.cat([distance, normal], dim=-1), leaves, "on a lattice through the body")

    def test_nothing_enters(self) -> None:
        """Points that start outside end outside, but for the curvature within one substep."""
        body = self._body()
        x, v = self._at(0.001 * samples.normal((200, 1), 5).abs())
        after = body.constrain(x, v, self.dt, None, 0)
        curved = float((self.dt * after.detach()).norm(dim=-1).max()) ** 2 / self.extent
        deepest = float(body.clearance(x + self.dt * after)[0].detach().min())
        require(deepest >= -curved - self.rounding, f"{-deepest:.2e} m deep after a substep")

    def test_what_starts_inside_is_moved_out_gently(self) -> None:
        """Points inside leave at the given speed, not at depth over dt, and do not go deeper."""
        body = self._body(recovery=0.05)
        x, v = self._at(torch.full((200, 1), -0.1 * self.extent, dtype=torch.float64))
        distance, normal = (part.detach() for part in body.clearance(x))
        still = body.constrain(x, torch.zeros_like(x), self.dt, None, 0).detach()
        speed = dot(still, normal)
        require((distance < 0).all(), "the trial did not start inside")
        require((speed > 0).all() and (still.norm(dim=-1) <= 0.05 * (1 + 1e-9)).all(), "not moved out at <= 0.05 m/s")
        moved = dot(body.constrain(x, v, self.dt, None, 0).detach(), normal)
        require((moved >= 0.05 * (1 - 1e-9)).all(), "what is inside goes deeper")

    def test_friction_stays_in_the_cone(self) -> None:
        """Friction opposes the slip, is at most mu times the push, and exactly that where points still slip."""
        body = self._body()
        x, v = self._at(torch.zeros(200, 1, dtype=torch.float64))
        after, normal = body.constrain(x, v, self.dt, None, 0).detach(), body.clearance(x)[1].detach()
        change, mu = after - v, float(body.friction.value.detach())
        push, slip, left = dot(change, normal), v - dot(v, normal) * normal, after - dot(after, normal) * normal
        taken = (change - push * normal).norm(dim=-1, keepdim=True)
        require((push > 0).any() and mu > 0, "nothing touches, or without friction")
        require((push >= 0).all() and (taken <= mu * push + 1e-9).all(), "outside the friction cone")
        require(
            (cross(left, slip).norm(dim=-1) <= 1e-9).all() and (dot(left, slip) >= -1e-9).all(), "slip is deflected"
        )
        slides = left.norm(dim=-1, keepdim=True) > 1e-6
        require((slides & (push > 0)).any(), "nothing slides")
        require_close(taken[slides], mu * push[slides], 1e-9, "sliding friction is not mu times the push")

    def test_forward_mode_agrees_with_reverse_mode(self) -> None:
        """Forward and reverse mode agree in positions and velocities."""
        body, (x, v) = self._body(moving=self.moving), self.sample()
        motion, k = (self._prescribe(self._travel()) if self.moving else None), 1
        weight, along = samples.normal(tuple(x.shape), 6), samples.normal((2, *x.shape), 7)

        def answer(x: Tensor, v: Tensor) -> Tensor:
            return (weight * body.constrain(x, v, self.dt, motion, k)).sum()

        forward = torch.func.jvp(answer, (x, v), (along[0], along[1]))[1]
        leaves = (x.clone().requires_grad_(), v.clone().requires_grad_())
        slopes = torch.autograd.grad(answer(*leaves), leaves)
        reverse = sum((a * b).sum() for a, b in zip(slopes, along, strict=True))
        require_close(forward, torch.as_tensor(reverse), 1e-10, "forward and reverse mode differ")

    def test_moves_as_a_rigid_body(self) -> None:
        """A travelling body responds as a fixed one does, as seen from the body."""
        x, v = self.sample()
        motion, k = self._prescribe(self._travel()), 77
        step, end = motion.increment[k], motion.pose[k]
        turn, origin = end[:3, :3], end[:3, 3]
        start = torch.linalg.inv(step) @ end
        world = x @ start[:3, :3].mT + start[:3, 3]
        carried = (world @ step[:3, :3].mT + step[:3, 3] - world) / self.dt
        moving = self._body(moving=True)
        require(moving.is_prescribed, "a moving collider must declare is_prescribed = True")
        got = moving.constrain(world, v @ turn.mT + carried, self.dt, motion, k).detach()
        fixed = self._body(moving=False).constrain(x, v, self.dt, None, k).detach()
        require_close(got, fixed @ turn.mT + carried, 1e-9, "a moving body answers differently from a fixed one")
        require((origin.abs() > 0.01).any(), "the body did not travel")
