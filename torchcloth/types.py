"""Containers that pass between rooms. SI units, right-handed, z up; leading batch dimensions are written ``...``.

All are NamedTuples: no other container survives Lightning's device transfer, vmap, collate, checkpoint and compile.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

VELOCITY_MEMORY_KEYS = ("contact",)  # internal variables that are velocities, and 0 at rest
Memory = dict[str, Tensor]  # internal variables by owner, "material" or "effects.NAME": [..., N, K] each


class ClothState(NamedTuple):
    """What the integrator carries from one substep to the next.

    It holds no affine velocity: that is derived from the mesh at every step, so a turning sheet is not braked.

    Attributes:
        x: [..., V, 3] m, vertex positions.
        v: [..., V, 3] m/s, vertex velocities.
        d3: [..., P, 3] -, elastic director of each contact point (P = 0 without contact).
        memory: internal variables of the material and the effects: plastic set, internal friction, creases.
    """

    x: Tensor
    v: Tensor
    d3: Tensor
    memory: Memory = {}

    def map(self, function: Callable[[Tensor], Tensor]) -> ClothState:
        """Return the state with ``function`` applied to every tensor."""
        memory = {name: function(value) for name, value in self.memory.items()}
        return ClothState(function(self.x), function(self.v), function(self.d3), memory)

    def at_rest(self) -> ClothState:
        """Return the state with all velocities set to zero, also those among the internal variables."""
        memory = {
            name: torch.zeros_like(value) if name in VELOCITY_MEMORY_KEYS else value
            for name, value in self.memory.items()
        }
        return self._replace(v=torch.zeros_like(self.v), memory=memory)


class Surface(NamedTuple):
    """Kinematics of the E triangles, computed once per substep and shared by material, effects and contact.

    Attributes:
        f1: [..., E, 3] -, warp column of the deformation gradient.
        f2: [..., E, 3] -, weft column of the deformation gradient.
        cofactor1: [..., E, 3] -, dJ/df1 = f2 x n.
        cofactor2: [..., E, 3] -, dJ/df2 = n x f1.
        n: [..., E, 3] -, unit normal.
        J: [..., E, 1] -, area ratio.
        area: [E, 1] m^2, rest area.
        v: [..., E, 3] m/s, centroid velocity.
    """

    f1: Tensor
    f2: Tensor
    cofactor1: Tensor
    cofactor2: Tensor
    n: Tensor
    J: Tensor
    area: Tensor
    v: Tensor


class EffectInputs(NamedTuple):
    """What an effect sees of the cloth in one substep.

    Attributes:
        x: [..., V, 3] m, vertex positions.
        v: [..., V, 3] m/s, vertex velocities.
        surface: kinematics of the triangles.
        mass: [..., V, 1] kg, vertex masses.
        memory: [..., N, K], the effect's own internal variables; None if it has none.
        dt: time since the internal variables were last updated [s].
        compensation: [..., V, 3] m, rounding error of ``x`` in float32 (``surface`` includes it); None: not known.
    """

    x: Tensor
    v: Tensor
    surface: Surface
    mass: Tensor
    memory: Tensor | None = None
    dt: float = 0.0
    compensation: Tensor | None = None


class Trajectory(NamedTuple):
    """The motion of one end effector or collider, given at knots; the layer interpolates it (C1, cubic).

    Attributes:
        t: [K] s, strictly increasing.
        pose: [..., K, 4, 4] m, maps body coordinates to the world:
            p_world = pose[..., :3, :3] @ p_body + pose[..., :3, 3].
        closed: [K] bool, the gripper holds the cloth from this knot until the next.
    """

    t: Tensor
    pose: Tensor
    closed: Tensor


class Rollout(NamedTuple):
    """A simulated motion at the requested frame times.

    Attributes:
        t: [T] s.
        x: [..., T, V, 3] m, vertex positions.
        v: [..., T, V, 3] m/s, vertex velocities.
        wrench: by driven boundary, [..., T, 6] N and N m: what the cloth exerts on the body. Force and moment about the
            body's origin, in world axes, as the mean over the interval that ends at the frame (frame 0: zero).
        state: the state at the last frame, from which a simulation can continue.
    """

    t: Tensor
    x: Tensor
    v: Tensor
    wrench: dict[str, Tensor]
    state: ClothState
