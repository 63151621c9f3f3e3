"""The containers that cross floors. SI units, right-handed, z up; leading batch dimensions are written ``...``.

NamedTuples: the one container that survives Lightning's device transfer, vmap, collate, checkpoint and compile.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

VELOCITY_MEMORY_KEYS = ("contact",)  # internal variables that are velocities
Memory = dict[str, Tensor]  # internal variables by owner, "material" or "effects.NAME": [..., N, K] each


class ClothState(NamedTuple):
    """What the integrator carries from one substep to the next.

    No affine velocity is stored: it is derived from the mesh at every step, so that a turning sheet is not braked.
    """

    x: Tensor  # [..., V, 3] m, vertex positions
    v: Tensor  # [..., V, 3] m/s, vertex velocities
    d3: Tensor  # [..., P, 3] -, elastic director of each contact point (P = 0 without contact)
    memory: Memory = {}  # what the material and effects remember: plastic set, internal friction, creases

    def map(self, function: Callable[[Tensor], Tensor]) -> ClothState:
        """The state with ``function`` applied to every tensor."""
        memory = {name: function(value) for name, value in self.memory.items()}
        return ClothState(function(self.x), function(self.v), function(self.d3), memory)

    def at_rest(self) -> ClothState:
        """The state without any velocity, of which rest has none."""
        memory = {name: torch.zeros_like(own) if name in VELOCITY_MEMORY_KEYS else own for name, own in self.memory.items()}
        return self._replace(v=torch.zeros_like(self.v), memory=memory)


class Surface(NamedTuple):
    """Kinematics of the E triangles, computed once per substep and shared by material, effects and contact."""

    f1: Tensor  # [..., E, 3] -, deformation gradient's warp column
    f2: Tensor  # [..., E, 3] -, deformation gradient's weft column
    cofactor1: Tensor  # [..., E, 3] -, dJ/df1 = f2 x n
    cofactor2: Tensor  # [..., E, 3] -, dJ/df2 = n x f1
    n: Tensor  # [..., E, 3] -, unit normal
    J: Tensor  # [..., E, 1] -, area ratio
    area: Tensor  # [E, 1] m^2, rest area
    v: Tensor  # [..., E, 3] m/s, centroid velocity


class EffectInputs(NamedTuple):
    """What an effect sees of the cloth in one substep."""

    x: Tensor  # [..., V, 3] m
    v: Tensor  # [..., V, 3] m/s
    surface: Surface
    mass: Tensor  # [..., V, 1] kg
    memory: Tensor | None = None  # [..., N, K], the effect's own internal variables
    dt: float = 0.0  # s, since the internal variables were last evolved
    compensation: Tensor | None = None  # [..., V, 3] m, what was too small to be added to x in float32; the surface knows it


class Trajectory(NamedTuple):
    """The motion of one end effector or collider, given at knots; the layer interpolates it (C1, cubic).

    ``pose`` maps body coordinates to the world: p_world = pose[..., :3, :3] @ p_body + pose[..., :3, 3].
    """

    t: Tensor  # [K] s, strictly increasing
    pose: Tensor  # [..., K, 4, 4] m
    closed: Tensor  # [K] bool, the gripper holds the cloth from this knot until the next


class Rollout(NamedTuple):
    """A simulated motion at the requested frame times.

    ``wrench`` holds, for every driven boundary, what the cloth exerts on the body: force [N] and moment [N m] in world
    axes about the body's own origin, as the mean over the interval that ends at the frame (frame 0: zero).
    """

    t: Tensor  # [T] s
    x: Tensor  # [..., T, V, 3] m
    v: Tensor  # [..., T, V, 3] m/s
    wrench: dict[str, Tensor]  # name -> [..., T, 6] N, N m
    state: ClothState  # the state at the last frame: pass it on to continue
