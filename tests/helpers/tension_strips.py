"""A strip in a tension machine, at rest: Newton's method on the library's membrane energy, in the plane."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, radians, sin

import numpy as np
import torch
from torch import Tensor

import torchcloth as tc
from torchcloth.dynamics import substep

RELATIVE_FORCE_TOLERANCE = 1e-9  # of the largest force on a vertex, relative to the pull


@dataclass
class Strip:
    """A strip that is pulled along world x.

    Attributes:
        length: m.
        width: m.
        angle: degrees, from the warp to x.
        material: the law.
        resolution: vertices along and across.
        clamped: the ends cannot move across; otherwise they slide, and the strain is uniform.
        crowded: 0 to 1, refinement of the mesh towards the ends, where clamps disturb the strain.
    """

    length: float
    width: float
    angle: float
    material: tc.materials.AbstractMaterial
    resolution: tuple[int, int] = (13, 4)
    clamped: bool = False
    crowded: float = 0.0

    def __post_init__(self):
        flat = tc.meshes.rectangle(self.length, self.width, resolution=self.resolution)
        c, s = cos(radians(self.angle)), sin(radians(self.angle))
        vertices = flat.vertices.copy()
        share = vertices[:, 0] / self.length
        vertices[:, 0] += self.crowded * self.length * ((1 - np.cos(np.pi * share)) / 2 - share)
        mesh = tc.meshes.Mesh.build(vertices, flat.faces, vertices[:, :2] @ [[c, -s], [s, c]])
        self.cloth = tc.Cloth(mesh, self.material, 0.1, contact=None)
        self.faces = torch.as_tensor(mesh.faces.copy())
        self.rest = self.cloth.rest_state().x[:, :2].detach()
        self.left = self.rest[:, 0] < 1e-9
        self.right = self.rest[:, 0] > self.length - 1e-9
        fixed = torch.stack([self.left | self.right, torch.zeros_like(self.left)], dim=-1)
        fixed[:, 1] = self.left | self.right if self.clamped else (self.rest.norm(dim=-1) < 1e-9)
        self.free = ~fixed.flatten()
        self.start = None

    def energy(self, x: Tensor) -> Tensor:
        """Return the energy [J] at positions [V, 2] m."""
        return self._energy_of_corners(x[self.faces])

    def _energy_of_corners(self, corners: Tensor) -> Tensor:
        """Return the energy [J] of separate triangles with corners [..., E, 3, 2] m."""
        model = self.cloth.build_model()
        x = corners.transpose(-3, -2).flatten(-3, -2)
        x = torch.cat([x, torch.zeros_like(x[..., :1])], dim=-1)
        geometry = model.geometry._replace(corners=torch.arange(x.shape[-2]))
        s = substep.surface(geometry, x, torch.zeros_like(x))
        return (geometry.area * model.material.membrane_energy(model.coefficients, s)).sum()

    def _derivatives(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return gradient [L, 2 V] and Hessian [L, 2 V, 2 V] of the energy, from 6 x 6 blocks of triangles."""
        corners, size = x[:, self.faces], 2 * x.shape[-2]
        slope = torch.func.grad(self._energy_of_corners)
        seeds = torch.eye(6).unflatten(-1, (3, 2)).expand(*corners.shape[:2], 6, 3, 2)
        blocks = torch.stack([torch.func.jvp(slope, (corners,), (seeds[:, :, k],))[1] for k in range(6)], dim=-3)
        index = (2 * self.faces.unsqueeze(-1) + torch.arange(2)).flatten(1)  # [E, 6]
        gradient = torch.zeros(len(x), size).index_add(1, index.flatten(), slope(corners).flatten(1))
        places = (size * index.unsqueeze(-1) + index.unsqueeze(-2)).flatten()
        second = torch.zeros(len(x), size * size).index_add(1, places, blocks.flatten(1))
        return gradient, second.unflatten(1, (size, size))

    def hessian(self, x: Tensor) -> Tensor:
        """Return the Hessian [2 V, 2 V] N/m of the energy at positions [V, 2] m."""
        with torch.no_grad():
            return self._derivatives(x[None])[1][0]

    def pull(self, elongation: Tensor) -> tuple[Tensor, Tensor]:
        """Return the forces [L] N at the elongations [L] m, and the positions [L, V, 2] m."""
        ramp = torch.stack([self.rest[:, 0] / self.length, torch.zeros(len(self.rest))], dim=-1)
        x = self.rest + elongation[:, None, None] * ramp if self.start is None else self.start
        with torch.no_grad():
            for _ in range(30):
                gradient, second = self._derivatives(x)
                force = gradient.unflatten(-1, (-1, 2))[:, self.right, 0].sum(-1)
                if float(gradient[:, self.free].abs().max()) < RELATIVE_FORCE_TOLERANCE * float(force.abs().max()):
                    self.start = x
                    return force, x
                step = torch.zeros_like(gradient)
                step[:, self.free] = torch.linalg.solve(second[:, self.free][..., self.free], gradient[:, self.free])
                x = x - step.unflatten(-1, (-1, 2))
        raise AssertionError("the strip has no equilibrium after 30 steps")
