"""Smooth fields over a cloth, the coarsest first."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..errors import InvalidInput
from ..meshes import Mesh

EQUAL = 1e-6  # relative, wave numbers that symmetry makes equal
NONE = 1e-12  # of the largest squared wave number, below which one is rounding's: each piece has one constant field


class Modes(NamedTuple):
    """Vibration shapes of a membrane with a free rim, at rest."""

    fields: Tensor  # [M, V] -, each of unit mean square over the area; of one piece the first is constant
    wave: Tensor  # [M] 1/m, wave numbers, ascending

    def doubt(self, count: int) -> list[str]:
        """A sentence where the first ``count`` end between two of one wave number, of which rounding chooses."""
        if not self._divides(count):
            return []
        better = [n for n in range(1, len(self.wave) + 1) if not self._divides(n)]
        near = [max([n for n in better if n < count], default=0), min(n for n in better if n > count)]
        return [
            f"{count} modes end between two of one wavelength, as a square cloth has them, or one in two pieces: which "
            f"of them counts is rounding's choice: take {' or '.join(str(n) for n in near if n)}"
        ]

    def _divides(self, count: int) -> bool:
        last = self.wave[count - 1 : count + 1]
        return len(last) == 2 and float(last[1] - last[0]) <= EQUAL * float(last[1])


def check_count(mesh: Mesh, count: int) -> None:
    """Refuse a number of modes that a mesh does not have.

    Raises:
        InvalidInput: fewer than one, or more than the mesh has vertices.
    """
    size = len(mesh.vertices)
    if not isinstance(count, int) or not 1 <= count <= size:
        raise InvalidInput("modes", got=count, expected=f"1 to {size}, the mesh's vertices")


def modes_of(mesh: Mesh, count: int | None = None) -> Modes:
    """The ``count`` coarsest; None: as many as there are vertices.

    Eigenvectors of the rest shape's Laplacian (linear triangles, lumped area): they follow the fabric through seams, so
    that a sleeve's front and back are neighbours only around its side.

    Raises:
        InvalidInput: fewer than one, or more than the mesh has vertices.
    """
    size = len(mesh.vertices)
    count = size if count is None else count
    check_count(mesh, count)
    rest, faces = torch.as_tensor(mesh.rest).double(), torch.as_tensor(mesh.faces)
    edges = torch.stack([rest[:, 1] - rest[:, 0], rest[:, 2] - rest[:, 0]], dim=-1)
    two = torch.linalg.inv(edges)  # rows: gradients of the second and third corner's hat functions
    gradient = torch.cat([-two.sum(1, keepdim=True), two], dim=1)
    local = torch.as_tensor(mesh.area).double()[:, None, None] * (gradient @ gradient.mT)
    places = (faces[:, :, None] * size + faces[:, None, :]).flatten()
    stiffness = torch.zeros(size * size, dtype=torch.float64).index_add(0, places, local.flatten()).reshape(size, size)
    root = torch.as_tensor(mesh.vertex_area).double().sqrt()
    squared, vectors = torch.linalg.eigh(stiffness / root[:, None] / root[None, :])
    fields = vectors[:, :count].mT / root * root.square().sum().sqrt()
    largest = fields.gather(1, fields.abs().argmax(1, keepdim=True))
    wave = torch.where(squared > NONE * squared[-1], squared, 0.0)[:count].sqrt()
    return Modes(fields * largest.sign(), wave)  # eigh leaves the signs open
