"""Deformation gradients of a mesh's triangles, and the forces of stresses, for effects with a law of their own."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ..meshes import Mesh


class Triangles(nn.Module):
    """Constants of a mesh's triangles, as buffers."""

    def __init__(self) -> None:
        super().__init__()
        for name, like in (("corners", torch.long), ("gradient", None), ("area", None), ("shear_bound", None)):
            self.register_buffer(name, torch.zeros(0, dtype=like), persistent=False)
        self.corners: Tensor  # [3 E], vertices: all first corners, then all second, then all third
        self.gradient: Tensor  # [3, 2, E, 1] 1/m, of the corners' shape functions along warp and weft
        self.area: Tensor  # [E, 1] m^2
        self.shear_bound: Tensor  # [V, 1] -; over mass it bounds omega^2 per unit of shear stiffness [N/m]

    def bind(self, mesh: Mesh, device: torch.device | None = None) -> Triangles:
        """Resolve the mesh, and return self."""
        dtype, gradient = torch.get_default_dtype(), mesh.shape_gradient
        # a triangle alone, with its share of the mass (Irons and Treharne 1971)
        largest = 3 * (gradient**2).sum((1, 2)).max()
        self.corners = torch.as_tensor(mesh.faces.T.ravel().copy(), device=device)
        self.gradient, self.area, self.shear_bound = (
            torch.as_tensor(value, dtype=dtype, device=device).unsqueeze(-1)
            for value in (gradient.transpose(1, 2, 0).copy(), mesh.area, mesh.vertex_area * largest)
        )
        return self

    def at_corners(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return vertex values [..., V, 3] at the first, second and third corners, [..., E, 3] each."""
        first, second, third = x.index_select(-2, self.corners).unflatten(-2, (3, -1)).unbind(-3)
        return first, second, third

    def sum_on_vertices(self, corners: Sequence[Tensor]) -> Tensor:
        """Sum values [..., E, 3] at the three corners on the vertices, [..., V, 3]."""
        values = torch.cat(list(corners), dim=-2)
        zero = values.new_zeros(*values.shape[:-2], len(self.shear_bound), 3)
        return zero.scatter_add(-2, self.corners.unsqueeze(-1).expand(values.shape), values)

    def deformation_columns(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return warp and weft columns of the deformation gradient, [..., E, 3] each; for velocities, their rates."""
        x0, x1, x2 = self.at_corners(x)
        (a1, b1), (a2, b2) = self.gradient[1], self.gradient[2]
        return a1 * (x1 - x0) + a2 * (x2 - x0), b1 * (x1 - x0) + b2 * (x2 - x0)

    def stress_force(self, p1: Tensor, p2: Tensor) -> Tensor:
        """Return the forces [..., V, 3] N of a first Piola-Kirchhoff stress with columns [..., E, 3] N/m."""
        second, third = (-self.area * (g[0] * p1 + g[1] * p2) for g in self.gradient[1:])
        return self.sum_on_vertices([-(second + third), second, third])
