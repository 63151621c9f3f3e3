"""A gripper that grips a patch of cloth."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from .._utils.linalg import rigid_displacement
from ..errors import InvalidInput
from ..meshes import Mesh
from .base import AbstractBoundary, PrescribedMotion

Corner = Literal["lower-left", "lower-right", "upper-left", "upper-right"]


class Grasp(AbstractBoundary):
    """Vertices that follow an end effector rigidly while it is closed.

    Every substep applies the body's increment of motion to the gripped vertices. So nothing has to be stored at the
    time of closing, and nothing drifts.

    Args:
        vertices: indices of the gripped vertices; or
        uv: [G, 2] m, pattern coordinates of patch centres, with
        radius: of the patch [m].

    Raises:
        InvalidInput: both or neither of vertices and uv; a patch without vertices.
    """

    is_prescribed = True

    def __init__(
        self, vertices: Sequence[int] | None = None, *, uv: ArrayLike | None = None, radius: float = 0.015
    ) -> None:
        super().__init__()
        if (vertices is None) == (uv is None):
            raise InvalidInput("Grasp", got="both or neither of vertices and uv", expected="exactly one of them")
        self._uv, self.radius, self._has_fixed_vertices = None if uv is None else _centres(uv), float(radius), False
        self._corner: Corner | None = None
        self._place: str | None = None
        self.register_buffer("index", _indices([] if vertices is None else vertices), persistent=False)
        self.index: Tensor

    @classmethod
    def corner(cls, corner: Corner, radius: float = 0.015) -> Grasp:
        """Build a grasp of the patch at a corner of the pattern's bounding box, such as "lower-left".

        Raises:
            InvalidInput: no such corner.
        """
        if corner not in ("lower-left", "lower-right", "upper-left", "upper-right"):
            raise InvalidInput(
                "corner", got=repr(corner), expected='"lower-left", "lower-right", "upper-left" or "upper-right"'
            )
        grasp = cls(uv=[[0.0, 0.0]], radius=radius)
        grasp._corner = corner
        return grasp

    @classmethod
    def at(cls, place: str, radius: float = 0.015) -> Grasp:
        """Build a grasp of a named place of the mesh, such as "left shoulder", and of what lies within ``radius`` [m].

        Layers that lie on each other are pinched together. ``mesh.places`` has the names.
        """
        grasp = cls(vertices=[], radius=radius)
        grasp._place = place
        return grasp

    @property
    def uv(self) -> np.ndarray | None:
        """Pattern coordinates [G, 2] m of the patch's centres; None for a patch given by vertices or by name.

        A ``corner`` has them once it is bound to a mesh.
        """
        return None if self._uv is None else np.atleast_2d(self._uv)

    def shifted(self, wider: float, along: float) -> Grasp:
        """Return a grasp of the same vertices, for a mesh whose patch is ``wider`` and shifted ``along`` u, both in m.

        Raises:
            InvalidInput: a patch that was not given by uv.
        """
        if self.uv is None:
            raise InvalidInput("Grasp.moved", got="a patch without a place", expected="one that was given by uv")
        return Grasp(uv=self.uv + np.array([along, 0.0]), radius=self.radius + wider).with_vertices(self.index)

    def with_vertices(self, vertices: Tensor) -> Grasp:
        """Return the same patch or place with the vertices [H] in it, whatever a mesh has there."""
        grasp = copy.deepcopy(self)
        grasp.index, grasp._has_fixed_vertices = vertices.clone(), True
        return grasp

    def bind(self, mesh: Mesh) -> Grasp:
        """Find the gripped vertices by the mesh's pattern coordinates or places, and return self.

        Raises:
            InvalidInput: no vertex, or vertices that the mesh does not have.
        """
        if not self._has_fixed_vertices:
            self._find_vertices(mesh)
        self.index = self.index.unique()  # a vertex named twice would count twice in the wrench
        if len(self.index) == 0 or int(self.index.min()) < 0 or int(self.index.max()) >= len(mesh.vertices):
            raise InvalidInput(
                "Grasp vertices",
                got=np.asarray(self.index.cpu()).tolist(),
                expected=f"indices in 0..{len(mesh.vertices) - 1}",
            )
        return self

    def _find_vertices(self, mesh: Mesh) -> None:
        if self._place is not None:
            self.index = torch.as_tensor(mesh.vertices_at_place(self._place, self.radius), device=self.index.device)
        if self._corner is not None:
            uv = mesh.uv
            if uv is None:
                got = "a mesh without pattern coordinates" if mesh.pattern is None else "a mesh of several panels"
                raise InvalidInput(
                    "Grasp.corner", got=got, expected="a mesh with uv", remedy="use Grasp.at or name the vertices"
                )
            low, high = uv.min(0), uv.max(0)
            vertical, horizontal = self._corner.split("-")
            self._uv = [[(low if horizontal == "left" else high)[0], (low if vertical == "lower" else high)[1]]]
        if self._uv is not None:
            self.index = torch.as_tensor(
                mesh.vertices_near_pattern_points(self._uv, self.radius), device=self.index.device
            )

    def prescribed_vertices(self, prescribed: PrescribedMotion | None, substep: int) -> Tensor | None:
        """Return all gripped vertices while the gripper is closed, else None."""
        return self.index if prescribed is not None and prescribed.closed[substep] else None

    def constrain(self, x: Tensor, v: Tensor, dt: float, prescribed: PrescribedMotion | None, substep: int) -> Tensor:
        """Set the velocities of gripped vertices so that they arrive exactly where the body carries them."""
        if prescribed is None or self.prescribed_vertices(prescribed, substep) is None:
            return v
        gripped = x.index_select(-2, self.index)
        velocity = rigid_displacement(prescribed.increment[..., substep, :, :], gripped) / dt
        v = v.expand(*velocity.shape[:-2], *v.shape[-2:])
        return v.index_copy(-2, self.index, velocity)

    def extra_repr(self) -> str:
        """Return the line of the data sheet: number of vertices."""
        return f"{len(self.index)} vertices"


def _centres(uv: ArrayLike) -> np.ndarray:
    try:
        centres = np.atleast_2d(np.asarray(uv, dtype=float))
    except (TypeError, ValueError, RuntimeError) as error:
        raise InvalidInput("Grasp uv", got=f"{uv!r}"[:60], expected="pattern points [G, 2] in metres") from error
    if centres.ndim != 2 or centres.shape[1] != 2 or not len(centres) or not np.isfinite(centres).all():
        got = f"shape {np.shape(uv)}"
        raise InvalidInput("Grasp uv", got=got, expected="finite pattern points [G, 2] in metres")
    return centres


def _indices(vertices: Sequence[int]) -> Tensor:
    """Return indices [H] int64; booleans and fractions, which would be taken for 0 and 1, are refused."""
    indices = np.asarray(vertices.cpu() if isinstance(vertices, Tensor) else vertices)
    if indices.ndim != 1 or (len(indices) and indices.dtype.kind not in "iu"):
        raise InvalidInput(
            "Grasp vertices",
            got=f"{indices.dtype} of shape {indices.shape}",
            expected="numbers of vertices",
            remedy="of a mask numpy.flatnonzero(mask)",
        )
    return torch.as_tensor(indices.astype(np.int64))
