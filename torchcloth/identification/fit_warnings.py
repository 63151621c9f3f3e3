"""Warnings of a fit: what a reader must know before using its numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ..cloth import Cloth
from ..episodes.observed import Episode
from .display_units import in_display_unit
from .nuisances import NuisanceSlice
from .uncertainty.estimates import EstimateSet


@dataclass(frozen=True)
class WarningThresholds:
    """From where on a fit warns.

    Attributes:
        max_residual_over_noise: rms residual over the sensor noise, above which model error may exceed the noise.
        max_force_error_over_constant: rms force error over that of constant forces, above which the forces show nothing
            but a weight.
        max_correlation: absolute correlation above which two parameters are called confounded.
        min_layer_separation_edges: distance in the fabric between triangles of different layers, in mean edges.
        max_layer_distance_edges: distance in space at which layers meet, in mean edges.
        checked_frames: frames of each episode in which layers are looked for.
        max_nuisance_prior_stds: distance of a nuisance from zero, in standard deviations of its prior, above which the
            two conflict.
    """

    max_residual_over_noise: float = 1.3
    max_force_error_over_constant: float = 0.9
    max_correlation: float = 0.95
    min_layer_separation_edges: float = 4
    max_layer_distance_edges: float = 1.5
    checked_frames: int = 8
    max_nuisance_prior_stds: float = 3.0


FIT_WARNING_THRESHOLDS = WarningThresholds()


def warn_of_skew(estimates: EstimateSet, curved_parameters: Sequence[str]) -> list[str]:
    """Suggest a profile for parameters whose slope changes over a standard error."""
    parameters = estimates.parameters
    names = [n for n in curved_parameters if parameters[n].identifiable and parameters[n].source == "data"]
    if not names:
        return []
    return [
        f"the intervals of {', '.join(names)} may be longer to one side (their slopes change within a standard error): "
        f"profile (--profile {' '.join(names)}) shows it"
    ]


def identifiability_warnings(estimates: EstimateSet) -> list[str]:
    """List fitted parameters that the data do not identify, or that are confounded."""
    warnings = []
    for name, estimate in estimates.parameters.items():
        if not estimate.identifiable and estimate.source == "data":
            warnings.append(f"{name} is not identifiable from these data: its value is no estimate")
    names = [n for n in estimates.correlation if estimates.parameters[n].source == "data"]
    for i, a in enumerate(names):
        for b in names[:i]:
            correlation = estimates.correlation[a][b]
            if abs(correlation) > FIT_WARNING_THRESHOLDS.max_correlation:
                warnings.append(f"{a} and {b} are confounded (correlation {correlation:+.2f})")
    return warnings


def fit_warnings(
    cloth: Cloth,
    episodes: Sequence[Episode],
    estimates: EstimateSet,
    fit: dict[str, float],
    frames: Sequence[Tensor],
    faces: Tensor,
    unbeaten_null: str = "",
) -> list[str]:
    """List what a reader must know before using the numbers, in sentences.

    Args:
        cloth: the model.
        episodes: of the fit.
        estimates: of the fit.
        fit: its distances and counts.
        frames: [T, V, 3] m of each episode at the solution.
        faces: [F, 3].
        unbeaten_null: of ``find_unbeaten_null``.
    """
    limits, warnings = FIT_WARNING_THRESHOLDS, []
    if unbeaten_null:
        warnings.append(f"the fit is no better than {unbeaten_null}: these data say nothing about it")
    elif math.isnan(fit["chamfer_after"]) and (
        fit["force_rms_after"] >= limits.max_force_error_over_constant * fit["force_rms_constant"]
    ):
        warnings.append("constant forces would do as well: these data weigh the cloth and say little else")
    if fit["chamfer_after"] > fit["chamfer_before"]:
        warnings.append(
            "the fitted values are farther from the points than the start: the robust cost fell, the mean did not"
        )
    warnings += identifiability_warnings(estimates)
    if "areal_density" not in estimates.correlation:
        warnings.append(
            "areal density was taken as exact: without force readings stiffness and density enter only as a ratio"
        )
    noise = [e.noise_std for e in episodes if e.noise_std]
    if noise and fit["rms_after"] > limits.max_residual_over_noise * max(noise):
        warnings.append(
            f"the residual ({fit['rms_after'] * 1e3:.1f} mm rms) exceeds {limits.max_residual_over_noise:g} times the "
            f"sensor noise ({max(noise) * 1e3:.1f} mm): the model misses something, and the standard errors do not "
            "cover it"
        )
    if not all(e.is_first_shape_measured for e in episodes):
        warnings.append(
            "an episode has no initial_vertices: the rest mesh, as placed in the file, was taken as the first frame"
        )
    warnings += [warning for e in episodes for warning in e.data_warnings()]
    if cloth.contact is None and _layers_meet(cloth, frames, faces):
        warnings.append("layers of the cloth come near each other, and contact was left out: fit with contact")
    return warnings


def nuisance_warnings(
    episodes: Sequence[Episode], nuisance_slices: Sequence[Sequence[NuisanceSlice]], raw: Tensor
) -> list[str]:
    """Name nuisances that ended far outside of their priors: another error may look like them.

    Args:
        episodes: of the fit.
        nuisance_slices: where their nuisances stand among the unknowns.
        raw: [K] the solution.
    """
    warnings = []
    for episode, slices in zip(episodes, nuisance_slices, strict=True):
        for s in slices:
            conflicts = [
                f"{name} {in_display_unit(unit, value)}"
                for name, unit, std, value in zip(s.names, s.units, s.stds, raw[s.index].tolist(), strict=True)
                if abs(value) > FIT_WARNING_THRESHOLDS.max_nuisance_prior_stds * std
            ]
            if conflicts:
                warnings.append(
                    f"{episode.name}: {', '.join(conflicts)} conflict with the prior "
                    f"({in_display_unit(s.units[0], s.stds[0])}): "
                    "another error, e.g. of the camera's or the robot's pose, may look the same"
                )
    return warnings


def _layers_meet(cloth: Cloth, frames: Sequence[Tensor], faces: Tensor) -> bool:
    """Whether triangles that are far apart in the fabric come near each other."""
    rest = torch.as_tensor(cloth.mesh.vertices, dtype=frames[0].dtype)[faces].mean(1)
    edge = cloth.mesh.mean_edge
    is_far_in_fabric = torch.cdist(rest, rest) > FIT_WARNING_THRESHOLDS.min_layer_separation_edges * edge
    for motion in frames:
        for x in motion[:: max(1, len(motion) // FIT_WARNING_THRESHOLDS.checked_frames)]:
            centres = x[faces].mean(1)
            is_near = torch.cdist(centres, centres) < FIT_WARNING_THRESHOLDS.max_layer_distance_edges * edge
            if bool((is_near & is_far_in_fabric).any()):
                return True
    return False
