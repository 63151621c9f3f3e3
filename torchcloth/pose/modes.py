"""Smooth fields over a cloth, the coarsest first."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ..errors import InvalidInput
from ..meshes import Mesh

EQUAL_WAVE_NUMBER_RELATIVE_TOLERANCE = 1e-6  # difference of wave numbers that symmetry makes equal
ZERO_EIGENVALUE_FRACTION = 1e-12  # of the largest squared wave number: below, it is the constant field of a piece


class Modes(NamedTuple):
    """Vibration shapes of a membrane with a free rim, at rest.

    Attributes:
        fields: [M, V] each of unit mean square over the area; that of a single piece begins with a constant one.
        wave_numbers: [M] 1/m, ascending.
    """

    fields: Tensor
    wave_numbers: Tensor

    def truncation_warnings(self, count: int) -> list[str]:
        """Return a warning where the first ``count`` modes end between two of one wave number."""
        if not self._splits_pair(count):
            return []
        allowed = [n for n in range(1, len(self.wave_numbers) + 1) if not self._splits_pair(n)]
        nearest = [max([n for n in allowed if n < count], default=0), min(n for n in allowed if n > count)]
        return [
            f"{count} modes end between two of one wavelength, as a square cloth has them, or one in two pieces: which "
            f"of them counts is rounding's choice: take {' or '.join(str(n) for n in nearest if n)}"
        ]

    def _splits_pair(self, count: int) -> bool:
        last = self.wave_numbers[count - 1 : count + 1]
        return len(last) == 2 and float(last[1] - last[0]) <= EQUAL_WAVE_NUMBER_RELATIVE_TOLERANCE * float(last[1])


def check_mode_count(mesh: Mesh, count: int) -> None:
    """Check that a mesh has this number of modes.

    Raises:
        InvalidInput: fewer than one, or more than the mesh has vertices.
    """
    size = len(mesh.vertices)
    if not isinstance(count, int) or not 1 <= count <= size:
        raise InvalidInput("modes", got=count, expected=f"1 to {size}, the mesh's vertices")


def compute_modes(mesh: Mesh, count: int | None = None) -> Modes:
    """Compute the ``count`` coarsest modes; None: as many as there are vertices.

    They are eigenvectors of the rest shape's Laplacian (linear triangles, lumped area). They follow the fabric through
    seams, so that a sleeve's front and back are neighbours only around its side.

    Raises:
        InvalidInput: fewer than one, or more than the mesh has vertices.
    """
    size = len(mesh.vertices)
    count = size if count is None else count
    check_mode_count(mesh, count)
    rest, faces = torch.as_tensor(mesh.rest).double(), torch.as_tensor(mesh.faces)
    edges = torch.stack([rest[:, 1] - rest[:, 0], rest[:, 2] - rest[:, 0]], dim=-1)
    last_two = torch.linalg.inv(edges)  # rows: gradients of the second and third corner's hat functions
    gradient = torch.cat([-last_two.sum(1, keepdim=True), last_two], dim=1)
    local = torch.as_tensor(mesh.area).double()[:, None, None] * (gradient @ gradient.mT)
    index = (faces[:, :, None] * size + faces[:, None, :]).flatten()
    stiffness = torch.zeros(size * size, dtype=torch.float64).index_add(0, index, local.flatten()).reshape(size, size)
    root = torch.as_tensor(mesh.vertex_area).double().sqrt()
    squared, vectors = torch.linalg.eigh(stiffness / root[:, None] / root[None, :])
    fields = vectors[:, :count].mT / root * root.square().sum().sqrt()
    largest = fields.gather(1, fields.abs().argmax(1, keepdim=True))
    wave_numbers = torch.where(squared > ZERO_EIGENVALUE_FRACTION * squared[-1], squared, 0.0)[:count].sqrt()
    return Modes(fields * largest.sign(), wave_numbers)  # eigh leaves the signs open
