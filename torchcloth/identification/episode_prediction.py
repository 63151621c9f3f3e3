"""What a fit says of an episode that it was not fitted to: where the cloth goes, how sure that is, how far off."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..cloth import Cloth
from ..episodes.observed import RATE, Episode, episode
from ..episodes.replay import Frames, each, simulate, tangents
from ..episodes.unknowns import Unknown, collect
from ..errors import SimulationDiverged, UnstableStep
from ..losses import closest
from ..losses.surface import distances
from ..recordings import Recording
from ..recordings.size_checks import check_size
from .estimators.levenberg_marquardt import NORMAL
from .estimators.linearity import NONLINEAR
from .io.saved_fit import SavedModel, Scene, read_saved, rebuilt, step_of
from .residuals.metrics import figures, forces_rms
from .residuals.rigid_carry import no_force, rigid_carry
from .result import or_none

CONVENTION = (
    "SI units. std_parameters: standard error [m] of a vertex's place (root mean square over the cloth and time, and "
    "the largest) by the covariance of the fitted parameters, linearised; where the motion is unstable, by steps of a "
    "standard error. std_law: rms distance that the fit left in its own episodes: sensor noise and what the law "
    "misses. interval: half width [m], along the surface's normal, of the 95 % interval of a measured point by both "
    "together (root mean square over the cloth and time, and the largest), and the share of the measured points "
    "inside. What differs between episodes (first shape, grasp, camera, clock) is in none of them. rms, chamfer: of "
    "the measured points from the simulated surface, one-sided; null: the cloth carried rigidly by the grippers. Null "
    "(JSON) where nothing was seen."
)
NOTICED = 1e-4  # m rms, that a standard error must move the cloth by for its tangents to be looked at


@dataclass(frozen=True, eq=False)
class EpisodePrediction:
    """The result of ``predict_episode``.

    Attributes:
        cloth: with the fitted values.
        episode: what drives it, and what was seen.
        frames: [T, V, 3] m at ``episode.times``, forces on the grippers.
        std: [T, V] m, standard error of a vertex's place by the parameters' covariance (all three axes together).
        wrench_std: gripper -> [T, 6] N, N m, likewise.
        law: m, rms distance that the fit left in its own episodes.
        interval: [T, F] m, half width of the 95 % interval of a point measured on a triangle, along its normal: by the
            parameters and by ``law`` together; NaN where the fit left none.
        inside: share of the measured points that lie in it, NaN without points.
        figures: distances [m] of what was seen, NaN where nothing was.
        per_frame: [T'] m, mean distance in the frames that have points.
        warnings: what a reader should know of it, in sentences.
    """

    cloth: Cloth
    episode: Episode
    frames: Frames
    std: Tensor
    wrench_std: dict[str, Tensor]
    law: float
    interval: Tensor
    inside: float
    figures: dict[str, float]
    per_frame: Tensor
    warnings: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """The content of prediction.json."""
        return {
            "episode": self.episode.name,
            "frames": len(self.std),
            "std_parameters": {"rms": float(self.std.square().mean().sqrt()), "max": float(self.std.max())},
            "std_law": or_none(self.law),
            "interval": {
                "rms": or_none(float(self.interval.square().mean().sqrt())),
                "max": or_none(float(self.interval.max())),
                "inside": or_none(self.inside),
            },
            "measured": {name: or_none(value) for name, value in self.figures.items()},
            "warnings": list(self.warnings),
            "convention": CONVENTION,
        }


def predict_episode(path: str | Path, recording: Recording, begun: Scene | None = None) -> EpisodePrediction:
    """Simulate any episode of the fitted cloth with the fitted values, with errors from their covariance.

    Args:
        path: identification.json, or the folder that holds it.
        recording: describes the same kind of cloth; points, markers and forces are only compared with. Without any
            there are twenty frames a second.
        begun: of a fit that began with a .tcm file: ``diagnosis.start_of(path)``.

    Raises:
        InvalidInput: there is no such file, or the fit is of another model.
        RecordingError: the file cannot be read; an episode that has no frames to predict, or was seen in another unit
            than metres.
    """
    model = read_saved(path)
    check_size(recording)
    cloth = rebuilt(path, model, recording, begun)
    unknowns, covariance = _known(model, cloth)
    data = episode(cloth, recording, RATE)
    raw = torch.tensor([u.start for u in unknowns], dtype=torch.float64)
    with step_of(path):
        frames, moved = tangents(cloth, unknowns, raw, data, model.dt)
        moved, lost, untried = _held_to_steps(cloth, unknowns, raw, data, model.dt, (frames, moved), covariance)
    found = with_errors(cloth, data, frames, moved, covariance, model.left)
    warnings = list(data.doubts())
    if lost:
        warnings.append(
            f"the motion is unstable or strongly nonlinear: tangents of {', '.join(lost)} miss what a standard error "
            "does, and were replaced by it; errors are no better than such a step"
        )
    if untried:
        warnings.append(
            f"a standard error of {', '.join(untried)} cannot be simulated, neither more nor less: whether tangents "
            "say what it does was not tried"
        )
    return replace(found, warnings=tuple(warnings))


@torch.no_grad()
def _held_to_steps(
    cloth: Cloth,
    unknowns: Sequence[Unknown],
    raw: Tensor,
    data: Episode,
    dt: float | None,
    both: tuple[Frames, Frames],
    covariance: Tensor,
) -> tuple[Frames, list[str], list[str]]:
    """(slopes, names of those that tangents miss, of those that were not tried).

    Tangents of unstable motion describe what is too small to matter.
    """
    frames, moved = both
    moved, lost, untried = each(moved, torch.clone), [], []
    for k, (unknown, std) in enumerate(zip(unknowns, covariance.diagonal().sqrt().tolist(), strict=True)):
        if not std > 0:
            continue
        found = _a_step_aside(cloth, unknowns, raw, data, dt, k, std)
        if found is None:
            untried.append(unknown.name)
            continue
        step, length = found
        secant = (step.x - frames.x) / length
        off = float((secant - moved.x[k]).norm() / secant.norm().clamp(min=1e-30))
        most = max(float(s.square().sum(-1).mean().sqrt()) for s in (secant, moved.x[k]))
        if std * most > NOTICED and not off < NONLINEAR:
            lost.append(unknown.name)
            moved.x[k], moved.v[k] = secant, (step.v - frames.v) / length
            for name, wrench in moved.wrench.items():
                wrench[k] = (step.wrench[name] - frames.wrench[name]) / length
    return moved, lost, untried


def _a_step_aside(
    cloth: Cloth, unknowns: Sequence[Unknown], raw: Tensor, data: Episode, dt: float | None, k: int, std: float
) -> tuple[Frames, float] | None:
    """(what a standard deviation more of the k-th changes, or one less, that step); None: neither can be simulated."""
    here, clip = float(raw[k]), unknowns[k].clip
    for way in (clip(here + std) - here, clip(here - std) - here):
        if abs(way) < 0.5 * std:  # at an end of what is legal
            continue
        there = raw.clone()
        there[k] += way
        with suppress(SimulationDiverged, UnstableStep):
            return simulate(cloth, unknowns, there, data, dt), way
    return None


def with_errors(
    cloth: Cloth, data: Episode, frames: Frames, moved: Frames, covariance: Tensor, law: float
) -> EpisodePrediction:
    """A simulation beside what was seen, with the errors that follow from derivatives along K numbers.

    Args:
        cloth, data, frames: what was simulated.
        moved: derivatives, with K in front.
        covariance: [K, K] of the numbers.
        law: m, rms distance that a fit left; NaN where that is not known.
    """
    spread = lambda slopes: torch.einsum("k...,kl,l...->...", slopes, covariance.to(slopes), slopes).clamp(min=0)  # noqa: E731
    seen, per_frame = _figures(cloth, data, frames)
    normal = _Along(torch.as_tensor(cloth.mesh.faces), frames.x, moved.x, covariance, law)
    return EpisodePrediction(
        cloth,
        data,
        frames,
        spread(moved.x).sum(-1).sqrt(),
        {name: spread(slopes).sqrt() for name, slopes in moved.wrench.items()},
        law,
        normal.of_triangles(),
        normal.inside(data),
        seen,
        per_frame,
    )


class _Along(NamedTuple):
    """The 95 % interval of measured points along the surface's normal."""

    faces: Tensor  # [F, 3]
    x: Tensor  # [T, V, 3] m
    slopes: Tensor  # [K, T, V, 3] of x
    covariance: Tensor  # [K, K]
    law: float  # m

    def of_triangles(self) -> Tensor:
        """[T, F] m, half its width at their centres."""
        return self._half(self.slopes[..., self.faces, :].mean(-2), self.x[..., self.faces, :])

    def inside(self, data: Episode) -> float:
        """Share of all measured points."""
        found = []
        for t, x in enumerate(self.x):
            cloud = data.positions(t)
            if len(cloud):
                hits = closest(cloud, x, self.faces)
                half = self._half(hits.on(self.slopes[:, t]), x[hits.corners])
                found.append(distances(cloud, x, hits) <= half)
        return float(torch.cat(found).double().mean()) if found and math.isfinite(self.law) else math.nan

    def _half(self, slopes: Tensor, corners: Tensor) -> Tensor:
        """Of places with slopes [K, ..., 3] on triangles with corners [..., 3, 3]."""
        a, b, c = corners.unbind(-2)
        normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
        along = (slopes * normal).sum(-1)
        variance = torch.einsum("k...,kl,l...->...", along, self.covariance.to(along), along).clamp(min=0)
        return NORMAL * (variance + self.law**2).sqrt()


def _known(model: SavedModel, cloth: Cloth) -> tuple[list[Unknown], Tensor]:
    """Fitted parameters at their values, and the covariance [K, K] of the unconstrained ones."""
    unknowns = collect(cloth, list(model.stds), None)
    stds = [model.stds[u.name] / u.slope(u.start) for u in unknowns]
    deviation, order = torch.tensor(stds, dtype=torch.float64), [list(model.stds).index(u.name) for u in unknowns]
    return unknowns, torch.as_tensor(model.correlation)[order][:, order] * deviation[:, None] * deviation


def _figures(cloth: Cloth, data: Episode, frames: Frames) -> tuple[dict[str, float], Tensor]:
    """Distances and force errors of the prediction and of the null."""
    faces = torch.as_tensor(cloth.mesh.faces)
    found, null = (figures([x], [data], faces) for x in (frames.x, rigid_carry(data)))
    out = {"rms": found.rms, "rms_null": null.rms, "chamfer": found.chamfer, "chamfer_null": null.chamfer}
    if data.wrenches:
        out["force_rms"] = forces_rms([frames.wrench], [data])
        out["force_rms_null"] = forces_rms([no_force(data)], [data])
    return out, found.per_frame
