"""Fields: one value per triangle, by reverse mode and a prior of smoothness."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from .._utils.files import write_text
from .._utils.resume import Journal
from .._utils.torch_modes import own_gradients
from ..cloth import Cloth
from ..episodes.observed import Episode, episode, on_cpu
from ..episodes.replay import Frames, Replay, frames_of
from ..episodes.unknowns import DECADE, needs_contact
from ..errors import InvalidInput
from ..meshes import Mesh
from ..parameters import PhysicalParameter, called, to_value
from ..recordings import Recording
from .estimators.gradient_descent import quasi_newton
from .estimators.objective import Objective
from .estimators.search import Progress, Search
from .given import given
from .residuals.blocks import Block, blocks_for
from .residuals.metrics import figures
from .result import or_none

NO_ERROR = "no error: gradient method"
CONVENTION = (
    "SI units. values: one for each triangle of the cloth's mesh, in its order: the likeliest under a prior of "
    "smoothness, in which they vary by a factor of e^contrast from side to side. chamfer, rms: as in "
    "identification.json."
)
CONTRAST = 1.0
FARTHEST = 2 * DECADE  # of a value from its start, unconstrained
RESULT = "fields.json"


@dataclass(frozen=True, eq=False)
class FieldFit:
    """The result of ``fit_fields``.

    Attributes:
        fields: by name, [F] one value per triangle, SI units. No errors: the search does not give them.
        contrast: of the smoothness prior.
        fit: distances [m], counts, seconds.
        warnings: what to mistrust.
        history: one entry per iteration, with each field's median.
        frames_before, frames_after: [T, V, 3] m for each episode.
    """

    fields: dict[str, Tensor]
    contrast: float
    fit: dict[str, Any]
    warnings: list[str]
    history: list[dict[str, Any]]
    frames_before: list[Tensor] = field(repr=False)
    frames_after: list[Tensor] = field(repr=False)

    def save(self, folder: str | Path) -> Path:
        """Write fields.json into ``folder``, atomically; returns its path."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        content = {
            "fields": {name: {"values": value.tolist(), "std": NO_ERROR} for name, value in self.fields.items()},
            "contrast": self.contrast,
            "fit": {name: or_none(value) for name, value in self.fit.items()},
            "convention": CONVENTION,
            "warnings": self.warnings,
            "history": [{name: or_none(value) for name, value in entry.items()} for entry in self.history],
        }
        return write_text(folder / RESULT, json.dumps(content, indent=1, allow_nan=False) + "\n")


@own_gradients()
def fit_fields(
    cloth: Cloth,
    recordings: Recording | Sequence[Recording],
    parameters: Sequence[str],
    *,
    contrast: float = CONTRAST,
    iterations: int = 35,
    dt: float | None = None,
    use: Sequence[str] | None = None,
    journal: str | Path | None = None,
    resume: bool | None = False,
    on_progress: Progress | None = None,
) -> FieldFit:
    """Fit material parameters that have one value per triangle, by L-BFGS on reverse-mode gradients.

    The prior is a graph Laplacian over the triangles, in the unconstrained coordinate (a logarithm for stiffnesses):
    sum over inner edges of length / distance of the centres * difference^2 / (2 contrast^2), of what a field has moved
    from its start, which does not depend on
    the mesh, and a factor of 10 for all values of a piece of cloth together.

    Args:
        cloth: model and start values, with fields, e.g. ``AEP(torch.full((F,), 1e5))``; left unchanged.
        recordings: one or several episodes of it.
        parameters: names of the material's fields, e.g. ["youngs_modulus"].
        contrast: how much a field may vary: 1 is a factor of some 2.7 between one side of a square and the other.
        iterations: at most.
        dt, use, journal, resume, on_progress: as of ``identify``; but where clouds end is left out, for no camera sees
            an edge where it is, and how far off it is is not among the unknowns here.

    Raises:
        InvalidInput: names that are no fields of the material, numbers out of range, or one episode twice.
        RecordingError: a recording without motion, with nothing seen or felt, or seen in another unit than metres.
    """
    began = time.perf_counter()
    on_cpu(cloth)
    if not (math.isfinite(contrast) and contrast > 0):
        raise InvalidInput("contrast", got=contrast, expected="a number > 0")
    if iterations < 1:
        raise InvalidInput("iterations", got=iterations, expected="at least 1")
    parameters = [parameters] if isinstance(parameters, str) else list(parameters)
    if not parameters:
        raise InvalidInput("parameters", got="none", expected="at least one name")
    every = given(recordings)
    own = {name: _field(cloth, name) for name in parameters}
    objective = _Fields(cloth, own, [episode(cloth, r) for r in every], dt, _without_rim(use), contrast)
    if journal is not None:
        objective.journal = Journal(journal, ["fields", *objective.identity()], resume)
    search = Search(objective, "converged", on_progress)
    raw, done = quasi_newton(objective, objective.start, iterations, search.record)
    before, after = objective.frames(objective.start), objective.frames(raw)
    fit: dict[str, Any] = {
        "iterations": len(search.history) - 1,
        "simulations": objective.simulations,
        "converged": done,
    }
    for key, frames in (("before", before), ("after", after)):
        now = figures(frames, objective.episodes, objective.faces)
        fit |= {f"chamfer_{key}": now.chamfer, f"rms_{key}": now.rms}
    fit["seconds"] = time.perf_counter() - began
    warnings = [f"{', '.join(own)}: {NO_ERROR}; where the data say little, neighbours' values and the start are shown"]
    warnings += [] if done else [f"stopped after {iterations} iterations before converging"]
    return FieldFit(objective.fields(raw), contrast, fit, warnings, search.history, before, after)


def _without_rim(use: Sequence[str] | str | None) -> tuple[Block, ...]:
    return tuple(block for block in blocks_for(use) if block.name != "edges")


def _field(cloth: Cloth, name: str) -> PhysicalParameter:
    part = dict(cloth.material.named_modules()).get(name)
    count = len(cloth.mesh.faces)
    if not isinstance(part, PhysicalParameter) or part.raw.shape != (count,) or part.domain == "nonnegative":
        expected = f"a parameter of the material with one value for each of {count} triangles"
        raise InvalidInput("field to fit", got=repr(name), expected=expected, remedy="identify fits single values")
    if needs_contact(cloth, f"material.{name}"):
        raise InvalidInput(
            "field to fit", got=repr(name), expected="a parameter of the model", remedy="it needs contact"
        )
    return part


class _Fields(Objective):
    """Fields as one vector; the search goes in coordinates in which the prior is a unit sphere."""

    patience = 4  # the first of a round, along a gradient of hundreds of numbers, is tiny

    def __init__(
        self, cloth: Cloth, own: dict[str, PhysicalParameter], episodes: list[Episode], dt, blocks, contrast: float
    ) -> None:
        super().__init__(cloth, [], episodes, dt, (), blocks)
        self.own = own
        self.start = torch.cat([part.raw.detach().double() for part in own.values()])
        self.middle = self.start
        precision = laplacian(cloth.mesh) / contrast**2
        piece = torch.as_tensor(connected_components(precision.numpy())[1])
        together = (piece[:, None] == piece).to(precision)  # of each piece of cloth, the mean
        precision = precision + together / (DECADE * together.sum(0)) ** 2
        self.root = torch.linalg.cholesky(torch.block_diag(*[precision] * len(own)))

    def _parts(self, raw: Tensor) -> dict[str, Tensor]:
        return dict(zip(self.own, raw.split(len(self.faces)), strict=True))

    def fields(self, raw: Tensor) -> dict[str, Tensor]:
        """Physical values [F] by name."""
        return {name: to_value(part, self.own[name].domain) for name, part in self._parts(raw).items()}

    def values(self, raw: Tensor) -> dict[str, float]:
        """Medians."""
        return {name: float(value.median()) for name, value in self.fields(raw).items()}

    def clip(self, raw: Tensor) -> Tensor:
        """Within two decades of the start: a line search that goes farther would need endless substeps."""
        return torch.minimum(torch.maximum(raw, self.middle - FARTHEST), self.middle + FARTHEST)

    def scaled(self, raw: Tensor) -> Tensor:
        """By the prior's Cholesky factor."""
        return self.root.mT @ (raw - self.middle)

    def unscaled(self, z: Tensor) -> Tensor:
        """Its inverse."""
        return self.middle + torch.linalg.solve_triangular(self.root.mT, z[:, None], upper=True)[:, 0]

    def pulled(self, slope: Tensor) -> Tensor:
        """Along the search's coordinates."""
        return torch.linalg.solve_triangular(self.root, slope[:, None], upper=False)[:, 0]

    def identity(self) -> list[object]:
        """With the prior."""
        return [*super().identity(), list(self.own), self.start, self.root]

    def simulate(self, raw: Tensor, i: int) -> Frames:
        """One episode with these fields."""
        data = self.episodes[i]
        entries = {f"cloth.material.{n}.raw": part.to(data.initial) for n, part in self._parts(raw).items()}
        return frames_of(called(Replay(self.cloth), entries, (data, self.dt)))


def _centres(sides: np.ndarray, length: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[F, 3] m each: where a triangle's centre lies beside each of its sides, along it and off it."""
    reach = sides / 3 - np.roll(sides, 1, axis=1) / 3  # from each corner: a third of the way to both others
    along = (reach * sides).sum(-1) / length
    off = np.abs(sides[..., 0] * reach[..., 1] - sides[..., 1] * reach[..., 0]) / length
    return along, off


def laplacian(mesh: Mesh) -> Tensor:
    """[F, F], of triangles across inner edges: edge length over distance of the centres, at rest and laid side by side.

    Panels that lie on each other are as far apart at a seam as anywhere else.
    """
    faces = np.asarray(mesh.faces)
    sides = np.roll(mesh.rest, -1, axis=1) - mesh.rest  # [F, 3, 2], from each corner to the next
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    order = np.lexsort(edges.T)
    same = (edges[order][1:] == edges[order][:-1]).all(1)
    first, second = order[:-1][same], order[1:][same]
    a, b = first // 3, second // 3
    length = np.linalg.norm(sides, axis=-1)
    along, above = _centres(sides, length)
    flipped = faces[a, first % 3] != faces[b, second % 3]  # neighbours go through their edge in opposite ways
    other = np.where(flipped, length[b, second % 3] - along[b, second % 3], along[b, second % 3])
    apart = np.hypot(above[a, first % 3] + above[b, second % 3], along[a, first % 3] - other)
    weight = torch.as_tensor(length[a, first % 3] / apart, dtype=torch.float64)
    out = torch.zeros(len(faces), len(faces), dtype=torch.float64)
    for i, j, sign in ((a, a, 1), (b, b, 1), (a, b, -1), (b, a, -1)):
        out.index_put_((torch.as_tensor(i), torch.as_tensor(j)), sign * weight, accumulate=True)
    return out
