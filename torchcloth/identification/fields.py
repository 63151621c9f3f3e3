"""Fit fields: one value per triangle, by reverse mode and a prior of smoothness."""

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
from .._utils.resume import ResumableStore
from .._utils.torch_modes import isolated_grad_mode
from ..cloth import Cloth
from ..episodes.observed import Episode, build_episode, check_recordings, require_cpu
from ..episodes.replay import Frames, Replay, frames_from_rollout
from ..episodes.unknowns import LOG_DECADE, needs_contact
from ..errors import InvalidInput
from ..meshes import Mesh
from ..parameters import PhysicalParameter, call_with_parameters, to_physical
from ..recordings import Recording
from .estimators.gradient_descent import minimise_by_lbfgs
from .estimators.objective import Objective
from .estimators.search import Progress, Search
from .residuals.blocks import Block, select_blocks
from .residuals.metrics import distance_metrics
from .result import nan_to_none

FIELDS_SCHEMA = "torchcloth.fields/1"
FIELDS_FILE_NAME = "fields.json"
NO_ERROR_NOTE = "no error: gradient method"
FIELDS_CONVENTION = (
    "SI units. values: one for each triangle of the cloth's mesh, in its order: the likeliest under a prior of "
    "smoothness, in which they vary by a factor of e^contrast from side to side. chamfer, rms: as in "
    "identification.json."
)
DEFAULT_CONTRAST = 1.0
MAX_LOG_CHANGE = 2 * LOG_DECADE  # of a value from its start, unconstrained


@dataclass(frozen=True, eq=False)
class FieldFit:
    """The result of ``fit_fields``.

    Attributes:
        fields: [F] one value per triangle by name, SI units. The search gives no errors.
        prior_contrast: of the smoothness prior.
        fit: distances [m], counts, seconds.
        warnings: what to mistrust.
        history: one entry per iteration, with each field's median.
        frames_before: [T, V, 3] m of each episode at the start values.
        frames_after: [T, V, 3] m of each episode at the fitted values.
    """

    fields: dict[str, Tensor]
    prior_contrast: float
    fit: dict[str, Any]
    warnings: list[str]
    history: list[dict[str, Any]]
    frames_before: list[Tensor] = field(repr=False)
    frames_after: list[Tensor] = field(repr=False)

    def save(self, folder: str | Path) -> Path:
        """Write fields.json into ``folder`` atomically, and return its path."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        content = {
            "schema": FIELDS_SCHEMA,
            "fields": {name: {"values": value.tolist(), "std": NO_ERROR_NOTE} for name, value in self.fields.items()},
            "contrast": self.prior_contrast,
            "fit": {name: nan_to_none(value) for name, value in self.fit.items()},
            "convention": FIELDS_CONVENTION,
            "warnings": self.warnings,
            "history": [{name: nan_to_none(value) for name, value in entry.items()} for entry in self.history],
        }
        return write_text(folder / FIELDS_FILE_NAME, json.dumps(content, indent=1, allow_nan=False) + "\n")


@isolated_grad_mode()
def fit_fields(
    cloth: Cloth,
    recordings: Recording | Sequence[Recording],
    parameters: Sequence[str],
    *,
    contrast: float = DEFAULT_CONTRAST,
    iterations: int = 35,
    dt: float | None = None,
    use: Sequence[str] | None = None,
    journal: str | Path | None = None,
    resume: bool | None = False,
    on_progress: Progress | None = None,
) -> FieldFit:
    """Fit material parameters that have one value per triangle, by L-BFGS on reverse-mode gradients.

    The prior is a graph Laplacian over the triangles, in the unconstrained coordinate (a logarithm for stiffnesses):
    the sum over inner edges of length / distance of the centres * difference^2 / (2 contrast^2). The differences are of
    the field's change from its start, so the prior does not depend on the mesh. All values of a piece of cloth together
    have a prior of a factor of 10.

    Args:
        cloth: model and start values, with fields, e.g. ``AEP(torch.full((F,), 1e5))``; left unchanged.
        recordings: one or several episodes of it.
        parameters: names of the material's fields, e.g. ["youngs_modulus"].
        contrast: how much a field may vary: 1 is a factor of some 2.7 between one side of a square and the other.
        iterations: largest number of iterations.
        dt: largest substep [s], as in ``identify``.
        use: kinds of data, as in ``identify``. The rim of the clouds is never used: no camera sees an edge where it is,
            and the rim's offset is not among the unknowns here.
        journal: folder of stored answers, as in ``identify``.
        resume: continue from the journal, as in ``identify``.
        on_progress: called after every iteration, as in ``identify``.

    Raises:
        InvalidInput: names that are no fields of the material, numbers out of range, or one episode twice.
        RecordingError: a recording without motion, without data, or in another unit than metres.
    """
    began = time.perf_counter()
    require_cpu(cloth)
    if not (math.isfinite(contrast) and contrast > 0):
        raise InvalidInput("contrast", got=contrast, expected="a number > 0")
    if iterations < 1:
        raise InvalidInput("iterations", got=iterations, expected="at least 1")
    parameters = [parameters] if isinstance(parameters, str) else list(parameters)
    if not parameters:
        raise InvalidInput("parameters", got="none", expected="at least one name")
    recordings = check_recordings(recordings)
    fitted = {name: _find_field(cloth, name) for name in parameters}
    episodes = [build_episode(cloth, r) for r in recordings]
    blocks = tuple(block for block in select_blocks(use) if block.name != "edges")
    objective = _FieldObjective(cloth, fitted, episodes, dt, blocks, contrast)
    if journal is not None:
        objective.journal = ResumableStore(journal, ["fields", *objective.fingerprint_parts()], resume)
    search = Search(objective, "converged", on_progress)
    raw, converged = minimise_by_lbfgs(objective, objective.start, iterations, search.append_history)
    before, after = objective.simulate_vertices(objective.start), objective.simulate_vertices(raw)
    fit: dict[str, Any] = {
        "iterations": len(search.history) - 1,
        "simulations": objective.simulations,
        "converged": converged,
    }
    for key, frames in (("before", before), ("after", after)):
        metrics = distance_metrics(frames, objective.episodes, objective.faces)
        fit |= {f"chamfer_{key}": metrics.chamfer, f"rms_{key}": metrics.rms}
    fit["seconds"] = time.perf_counter() - began
    warnings = [
        f"{', '.join(fitted)}: {NO_ERROR_NOTE}; where the data say little, the values are those of neighbours and of "
        "the start"
    ]
    unfinished = f"stopped after {iterations} iterations before converging: more of them may change the values"
    warnings += [] if converged else [unfinished]
    return FieldFit(objective.field_values(raw), contrast, fit, warnings, search.history, before, after)


def _find_field(cloth: Cloth, name: str) -> PhysicalParameter:
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


class _FieldObjective(Objective):
    """Fields as one vector; the search works in coordinates in which the prior is a unit sphere."""

    patience = 4  # the first step of a round, along a gradient of hundreds of numbers, is tiny

    def __init__(
        self,
        cloth: Cloth,
        fitted: dict[str, PhysicalParameter],
        episodes: Sequence[Episode],
        dt: float | None,
        blocks: Sequence[Block],
        contrast: float,
    ) -> None:
        super().__init__(cloth, [], episodes, dt, (), blocks)
        self.fitted = fitted
        self.start = torch.cat([part.raw.detach().double() for part in fitted.values()])
        self.prior_mean = self.start
        precision = triangle_laplacian(cloth.mesh) / contrast**2
        piece = torch.as_tensor(connected_components(precision.numpy())[1])
        same_piece = (piece[:, None] == piece).to(precision)  # constrains the mean of each piece of cloth
        precision = precision + same_piece / (LOG_DECADE * same_piece.sum(0)) ** 2
        self.precision_root = torch.linalg.cholesky(torch.block_diag(*[precision] * len(fitted)))

    def _split(self, raw: Tensor) -> dict[str, Tensor]:
        return dict(zip(self.fitted, raw.split(len(self.faces)), strict=True))

    def field_values(self, raw: Tensor) -> dict[str, Tensor]:
        """Return physical values [F] by name."""
        return {name: to_physical(part, self.fitted[name].domain) for name, part in self._split(raw).items()}

    def physical_values(self, raw: Tensor) -> dict[str, float]:
        """Return each field's median."""
        return {name: float(value.median()) for name, value in self.field_values(raw).items()}

    def clip(self, raw: Tensor) -> Tensor:
        """Clip to two decades around the start: a line search that goes farther would need endless substeps."""
        return torch.minimum(torch.maximum(raw, self.prior_mean - MAX_LOG_CHANGE), self.prior_mean + MAX_LOG_CHANGE)

    def to_scaled(self, raw: Tensor) -> Tensor:
        """Multiply the distance from the prior's mean by its Cholesky factor."""
        return self.precision_root.mT @ (raw - self.prior_mean)

    def from_scaled(self, z: Tensor) -> Tensor:
        """Invert ``to_scaled``."""
        return self.prior_mean + torch.linalg.solve_triangular(self.precision_root.mT, z[:, None], upper=True)[:, 0]

    def scale_gradient(self, gradient: Tensor) -> Tensor:
        """Convert a gradient to the search's coordinates."""
        return torch.linalg.solve_triangular(self.precision_root, gradient[:, None], upper=False)[:, 0]

    def fingerprint_parts(self) -> list[object]:
        """List everything that answers depend on, the prior included."""
        return [*super().fingerprint_parts(), list(self.fitted), self.start, self.precision_root]

    def simulate(self, raw: Tensor, i: int) -> Frames:
        """Simulate episode ``i`` with these fields."""
        episode = self.episodes[i]
        entries = {f"cloth.material.{n}.raw": part.to(episode.initial) for n, part in self._split(raw).items()}
        return frames_from_rollout(call_with_parameters(Replay(self.cloth), entries, (episode, self.dt)))


def _locate_centres(sides: np.ndarray, length: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where a triangle's centre lies relative to each of its sides, along it and off it, [F, 3] m each."""
    to_centre = sides / 3 - np.roll(sides, 1, axis=1) / 3  # from each corner: a third of the way to both others
    along = (to_centre * sides).sum(-1) / length
    off = np.abs(sides[..., 0] * to_centre[..., 1] - sides[..., 1] * to_centre[..., 0]) / length
    return along, off


def triangle_laplacian(mesh: Mesh) -> Tensor:
    """Return the graph Laplacian [F, F] of triangles across inner edges.

    Its weights are edge length over distance of the centres, at rest and unfolded into a plane. Panels that lie on each
    other are as far apart at a seam as anywhere else.
    """
    faces = np.asarray(mesh.faces)
    sides = np.roll(mesh.rest, -1, axis=1) - mesh.rest  # [F, 3, 2], from each corner to the next
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    order = np.lexsort(edges.T)
    is_pair = (edges[order][1:] == edges[order][:-1]).all(1)
    first, second = order[:-1][is_pair], order[1:][is_pair]
    a, b = first // 3, second // 3
    length = np.linalg.norm(sides, axis=-1)
    along, off = _locate_centres(sides, length)
    is_reversed = faces[a, first % 3] != faces[b, second % 3]  # neighbours usually go along their edge in opposite ways
    along_b = along[b, second % 3]
    along_b = np.where(is_reversed, length[b, second % 3] - along_b, along_b)
    distance = np.hypot(off[a, first % 3] + off[b, second % 3], along[a, first % 3] - along_b)
    weight = torch.as_tensor(length[a, first % 3] / distance, dtype=torch.float64)
    out = torch.zeros(len(faces), len(faces), dtype=torch.float64)
    for i, j, sign in ((a, a, 1), (b, b, 1), (a, b, -1), (b, a, -1)):
        out.index_put_((torch.as_tensor(i), torch.as_tensor(j)), sign * weight, accumulate=True)
    return out
