"""Predict an episode that a fit did not use: where the cloth goes, how sure that is, and how far off it was."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .._utils.constants import Z_95
from ..cloth import Cloth
from ..episodes.observed import DEFAULT_FRAME_RATE_HZ, Episode, build_episode
from ..episodes.replay import Frames, map_frames, simulate, simulate_with_tangents
from ..episodes.unknowns import Unknown, collect_unknowns
from ..errors import SimulationDiverged, UnstableStep
from ..inspection.corrections import check_recording
from ..losses import find_closest_points
from ..losses.surface import point_distances
from ..recordings import Recording
from ..recordings.size_checks import check_size
from .estimators.linearity import LINEARITY_CRITERIA
from .io.saved_fit import ClothBuilder, SavedFit, explain_unstable_step, read_saved_fit, rebuild_fitted_cloth
from .residuals.metrics import distance_metrics, force_rms
from .residuals.rigid_carry import carry_rigidly, zero_forces
from .result import nan_to_none

EPISODE_PREDICTION_SCHEMA = "torchcloth.episode-prediction/1"
EPISODE_PREDICTION_CONVENTION = (
    "SI units. std_parameters: standard error [m] of a vertex's position (root mean square over the cloth and time, "
    "and the largest) by the covariance of the fitted parameters, linearised; where the motion is unstable, by steps "
    "of a standard error. std_misfit: rms distance that the fit left in its own episodes: sensor noise and model "
    "error. interval: half width [m], along the surface's normal, of the 95 % interval of a measured point by both "
    "together (root mean square over the cloth and time, and the largest), and the fraction of the measured points "
    "inside (coverage). What differs between episodes (first shape, grasp, camera, clock) is in none of them. rms, "
    "chamfer: of the measured points from the simulated surface, one-sided; null: the cloth carried rigidly by the "
    "grippers. Null (JSON) where nothing was measured."
)
MIN_CHECKED_DISPLACEMENT_M = 1e-4  # rms displacement by a standard error, below which tangents are not checked
MIN_STEP_FRACTION = 0.5  # of a standard error, to which a legal step may be clipped


@dataclass(frozen=True, eq=False)
class EpisodePrediction:
    """The result of ``predict_episode``.

    Attributes:
        cloth: with the fitted values.
        episode: what drives it, and its measurements.
        frames: [T, V, 3] m at ``episode.times``, forces on the grippers.
        vertex_std: [T, V] m, standard error of a vertex's position by the parameters' covariance (all axes together).
        wrench_std: gripper -> [T, 6] N, N m, standard error of its wrench.
        misfit_std: m, rms distance that the fit left in its own episodes.
        half_width: [T, F] m, half width of the 95 % interval of a point measured on a triangle, along its normal, by
            the parameters and the misfit together; NaN where the misfit is not known.
        coverage: fraction of the measured points inside the interval, NaN without points.
        metrics: distances [m] of the measurements, NaN where there are none.
        per_frame: [T'] m, mean distance in the frames that have points.
        warnings: what a reader should know, in sentences.
    """

    cloth: Cloth
    episode: Episode
    frames: Frames
    vertex_std: Tensor
    wrench_std: dict[str, Tensor]
    misfit_std: float
    half_width: Tensor
    coverage: float
    metrics: dict[str, float]
    per_frame: Tensor
    warnings: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return the content of prediction.json."""
        return {
            "schema": EPISODE_PREDICTION_SCHEMA,
            "episode": self.episode.name,
            "frames": len(self.vertex_std),
            "std_parameters": {
                "rms": float(self.vertex_std.square().mean().sqrt()),
                "max": float(self.vertex_std.max()),
            },
            "std_misfit": nan_to_none(self.misfit_std),
            "interval": {
                "rms": nan_to_none(float(self.half_width.square().mean().sqrt())),
                "max": nan_to_none(float(self.half_width.max())),
                "coverage": nan_to_none(self.coverage),
            },
            "measured": {name: nan_to_none(value) for name, value in self.metrics.items()},
            "warnings": list(self.warnings),
            "convention": EPISODE_PREDICTION_CONVENTION,
        }


def predict_episode(
    path: str | Path, recording: Recording, build_start: ClothBuilder | None = None
) -> EpisodePrediction:
    """Simulate any episode of the fitted cloth with the fitted values, with errors from their covariance.

    Args:
        path: identification.json, or the folder that holds it.
        recording: describes the same kind of cloth. Points, markers and forces are only compared with. An episode
            without any has twenty frames a second.
        build_start: for a fit that began with a .tcm file: ``diagnosis.make_start_builder(path)``.

    Raises:
        InvalidInput: there is no such file, or the fit is of another model.
        RecordingError: the file cannot be read; an episode that has no frames to predict, or is in another unit than
            metres.
    """
    fit = read_saved_fit(path)
    check_size(recording)
    cloth = rebuild_fitted_cloth(path, fit, recording, build_start)
    unknowns, covariance = _fitted_unknowns(fit, cloth)
    episode = build_episode(cloth, check_recording(recording).recording, DEFAULT_FRAME_RATE_HZ)
    raw = torch.tensor([u.start for u in unknowns], dtype=torch.float64)
    with explain_unstable_step(path):
        frames, tangents = simulate_with_tangents(cloth, unknowns, raw, episode, fit.dt)
        tangents, replaced, unchecked = _replace_wrong_tangents(
            cloth, unknowns, raw, episode, fit.dt, frames, tangents, covariance
        )
    prediction = propagate_errors(cloth, episode, frames, tangents, covariance, fit.misfit_rms)
    warnings = list(episode.data_warnings())
    if replaced:
        warnings.append(
            f"the motion is unstable or strongly nonlinear: tangents of {', '.join(replaced)} miss what a standard "
            "error does, and were replaced by it; errors are no better than such a step"
        )
    if unchecked:
        warnings.append(
            f"a standard error of {', '.join(unchecked)} cannot be simulated, neither more nor less: whether tangents "
            "say what it does was not tried"
        )
    return replace(prediction, warnings=tuple(warnings))


@torch.no_grad()
def _replace_wrong_tangents(
    cloth: Cloth,
    unknowns: Sequence[Unknown],
    raw: Tensor,
    episode: Episode,
    dt: float | None,
    frames: Frames,
    tangents: Frames,
    covariance: Tensor,
) -> tuple[Frames, list[str], list[str]]:
    """Replace tangents that differ from a step of a standard error: in unstable motion they describe too little.

    Returns:
        The slopes, names of unknowns whose tangents were replaced, names of those that were not checked.
    """
    slopes, replaced, unchecked = map_frames(tangents, torch.clone), [], []
    for k, (unknown, std) in enumerate(zip(unknowns, covariance.diagonal().sqrt().tolist(), strict=True)):
        if not std > 0:
            continue
        shifted = _simulate_shifted(cloth, unknowns, raw, episode, dt, k, std)
        if shifted is None:
            unchecked.append(unknown.name)
            continue
        shifted_frames, step = shifted
        secant = (shifted_frames.x - frames.x) / step
        relative_error = float((secant - slopes.x[k]).norm() / secant.norm().clamp(min=1e-30))
        rms_slope = max(float(s.square().sum(-1).mean().sqrt()) for s in (secant, slopes.x[k]))
        is_noticeable = std * rms_slope > MIN_CHECKED_DISPLACEMENT_M
        if is_noticeable and not relative_error < LINEARITY_CRITERIA.max_relative_error:
            replaced.append(unknown.name)
            slopes.x[k], slopes.v[k] = secant, (shifted_frames.v - frames.v) / step
            for name, wrench in slopes.wrench.items():
                wrench[k] = (shifted_frames.wrench[name] - frames.wrench[name]) / step
    return slopes, replaced, unchecked


def _simulate_shifted(
    cloth: Cloth, unknowns: Sequence[Unknown], raw: Tensor, episode: Episode, dt: float | None, k: int, std: float
) -> tuple[Frames, float] | None:
    """(frames with the k-th unknown a standard deviation larger or smaller, step); None: neither can be simulated."""
    here, clip = float(raw[k]), unknowns[k].clip
    for step in (clip(here + std) - here, clip(here - std) - here):
        if abs(step) < MIN_STEP_FRACTION * std:  # at an end of the legal range
            continue
        shifted = raw.clone()
        shifted[k] += step
        with suppress(SimulationDiverged, UnstableStep):
            return simulate(cloth, unknowns, shifted, episode, dt), step
    return None


def propagate_errors(
    cloth: Cloth, episode: Episode, frames: Frames, slopes: Frames, covariance: Tensor, misfit_std: float
) -> EpisodePrediction:
    """Propagate the errors of K numbers to a simulation, and compare it with its measurements.

    Args:
        cloth: what was simulated.
        episode: what drove it, and its measurements.
        frames: the simulation.
        slopes: its derivatives, with K in front.
        covariance: [K, K] of the numbers.
        misfit_std: m, rms distance that a fit left; NaN where that is not known.
    """

    def variance(slopes: Tensor) -> Tensor:
        return torch.einsum("k...,kl,l...->...", slopes, covariance.to(slopes), slopes).clamp(min=0)

    metrics, per_frame = _compare_with_data(cloth, episode, frames)
    interval = _NormalInterval(torch.as_tensor(cloth.mesh.faces), frames.x, slopes.x, covariance, misfit_std)
    return EpisodePrediction(
        cloth=cloth,
        episode=episode,
        frames=frames,
        vertex_std=variance(slopes.x).sum(-1).sqrt(),
        wrench_std={name: variance(wrench_slopes).sqrt() for name, wrench_slopes in slopes.wrench.items()},
        misfit_std=misfit_std,
        half_width=interval.of_triangles(),
        coverage=interval.coverage(episode),
        metrics=metrics,
        per_frame=per_frame,
    )


class _NormalInterval(NamedTuple):
    """The 95 % interval of measured points along the surface's normal.

    Attributes:
        faces: [F, 3].
        x: [T, V, 3] m.
        slopes: [K, T, V, 3] of ``x``.
        covariance: [K, K].
        misfit_std: m.
    """

    faces: Tensor
    x: Tensor
    slopes: Tensor
    covariance: Tensor
    misfit_std: float

    def of_triangles(self) -> Tensor:
        """Return the half width [T, F] m at the triangles' centres."""
        return self._half_width(self.slopes[..., self.faces, :].mean(-2), self.x[..., self.faces, :])

    def coverage(self, episode: Episode) -> float:
        """Return the fraction of all measured points inside; NaN where it is not known."""
        inside = []
        for t, x in enumerate(self.x):
            cloud = episode.observed_points(t)
            if len(cloud):
                hits = find_closest_points(cloud, x, self.faces)
                half_width = self._half_width(hits.interpolate(self.slopes[:, t]), x[hits.corners])
                inside.append(point_distances(cloud, x, hits) <= half_width)
        is_known = inside and math.isfinite(self.misfit_std)
        return float(torch.cat(inside).double().mean()) if is_known else math.nan

    def _half_width(self, slopes: Tensor, corners: Tensor) -> Tensor:
        """At places with slopes [K, ..., 3] on triangles with corners [..., 3, 3]."""
        a, b, c = corners.unbind(-2)
        normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
        along = (slopes * normal).sum(-1)
        variance = torch.einsum("k...,kl,l...->...", along, self.covariance.to(along), along).clamp(min=0)
        return Z_95 * (variance + self.misfit_std**2).sqrt()


def _fitted_unknowns(fit: SavedFit, cloth: Cloth) -> tuple[list[Unknown], Tensor]:
    """Fitted parameters at their values, and the covariance [K, K] of the unconstrained ones."""
    unknowns = collect_unknowns(cloth, list(fit.stds), None)
    deviation = torch.tensor([fit.stds[u.name] / u.slope(u.start) for u in unknowns], dtype=torch.float64)
    order = [list(fit.stds).index(u.name) for u in unknowns]
    return unknowns, torch.as_tensor(fit.correlation)[order][:, order] * deviation[:, None] * deviation


def _compare_with_data(cloth: Cloth, episode: Episode, frames: Frames) -> tuple[dict[str, float], Tensor]:
    """Distances and force errors of the prediction and of the null."""
    faces = torch.as_tensor(cloth.mesh.faces)
    predicted, null = (distance_metrics([x], [episode], faces) for x in (frames.x, carry_rigidly(episode)))
    metrics = {
        "rms": predicted.rms,
        "rms_null": null.rms,
        "chamfer": predicted.chamfer,
        "chamfer_null": null.chamfer,
    }
    if episode.wrenches:
        metrics["force_rms"] = force_rms([frames.wrench], [episode])
        metrics["force_rms_null"] = force_rms([zero_forces(episode)], [episode])
    return metrics, predicted.per_frame
