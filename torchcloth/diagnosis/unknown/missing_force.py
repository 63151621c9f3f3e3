"""Missing force: where, when and in which direction a force would explain the residuals.

A pressure that is smooth over the fabric and constant within a time window is estimated beside the model. It is the
most likely one under a prior whose size the data set (weak-constraint variational assimilation, Tremolet 2006), with
the noise of a correct model (``lack_of_fit.reference_noise``). Tangents along all directions cost about as much as the
twenty passes of conjugate gradients with an adjoint, and give errors as well. Where the motion is unstable they grow
without bound: from there on folds decide, and nothing is estimated.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..._utils.constants import STANDARD_GRAVITY_M_PER_S2
from ...episodes.observed import Episode
from ...episodes.replay import Frames, map_frames
from ...pose.modes import compute_modes
from ...pose.objective import split_into_windows
from ..data.binning import BIN_SECONDS, align_rows, bin_residuals
from ..data.dataset import DiagnosisData, Progress
from ..decide.criteria import CRITERIA
from ..inference.fitting import ModelFit, prior_precision
from ..inference.lack_of_fit import reference_noise
from .force_sensitivities import ForcePulses, differentiate_pulses

WINDOW_S = 0.2  # time in which the force is constant
MODES_PER_AXIS = 8  # smooth fields over the fabric
FIELD_STDS_M_PER_S2 = 10 ** torch.linspace(-2.5, 1.5, 41, dtype=torch.float64)  # tried prior standard deviations
WINDOW_SWEEPS = 15  # iterations of learning a prior for each window
MAX_FREE_FLIGHT_FACTOR = 10.0  # displacement by 1 m/s^2 over the squared duration; in free flight it is 0.5
MAX_SLOPES_AT_ONCE = 100_000_000  # slopes of points, 0.8 GB: those of long motions would fill the memory
NEGLIGIBLE_FORCE_FACTOR = 1e-3  # of the smallest prior standard deviation: no force


class MotionForce(NamedTuple):
    """Missing force in one motion.

    Attributes:
        motion: label of the motion.
        windows: [W, 2] first and last time of each window, from the first frame [s].
        force: [W, V, 3] pressure along the axes of the world [Pa].
        std: [W, V, 3] its standard error [Pa].
        x: [W, V, 3] cloth in the middle of each window [m].
        unstable_from: time from the first frame from which forces have unbounded effects [s]; None: never.
    """

    motion: str
    windows: Tensor
    force: Tensor
    std: Tensor
    x: Tensor
    unstable_from: float | None

    @property
    def certainty(self) -> Tensor:
        """[W, V] standard errors by which the force differs from zero."""
        return (self.force / self.std).norm(dim=-1)

    @property
    def strongest(self) -> tuple[int, int]:
        """(window, vertex) at which the force is most significant."""
        index = int(self.certainty.argmax())
        return index // self.force.shape[1], index % self.force.shape[1]


@dataclass(frozen=True, eq=False)
class MissingForce:
    """Missing force in all motions.

    Attributes:
        motions: one for each episode.
        gain: log-likelihood of a missing force over none.
        weight: weight of the cloth per area [Pa].
        uv: [V, 2] pattern [m].
        faces: [F, 3] triangles.
        area: [V] area of each vertex [m^2].
    """

    motions: Sequence[MotionForce]
    gain: float
    weight: float
    uv: Tensor
    faces: Tensor
    area: Tensor

    def total(self, m: MotionForce) -> Tensor:
        """Return [W, 3] the sum over the cloth [N]."""
        return (m.force * self.area[:, None]).sum(1)

    def as_dict(self) -> dict[str, Any]:
        """Return the content of diagnosis.json: by motion, the most significant window and the pressure then."""
        return {
            "weight_pa": self.weight,
            "log_likelihood_gain": self.gain,
            "motions": [self._describe(m) for m in self.motions],
        }

    def _describe(self, m: MotionForce) -> dict[str, Any]:
        window, vertex = m.strongest
        direction = m.force[window, vertex] / m.force[window, vertex].norm().clamp(min=1e-30)
        along = (m.force[window] @ direction).clamp(min=0.0)
        weight = along.square() * self.area  # forces in the opposite direction have their middle elsewhere
        fraction = weight / weight.sum().clamp(min=1e-30)  # a motion without bins has no force
        middle, pressure = ((fraction[:, None] * values).sum(0) for values in (self.uv, m.force[window]))
        if along[(self.uv - middle).norm(dim=1).argmin()] <= 0.5 * along[vertex]:  # it lies between two places
            middle = self.uv[vertex]
        z = float(m.certainty[window].max())
        return {
            "motion": m.motion,
            "rms": float(m.force.square().sum(-1).mean().sqrt()),
            "at": middle.tolist(),
            "from": float(m.windows[window, 0]),
            "to": float(m.windows[window, 1]),
            "pressure": pressure.tolist(),
            "total_force": self.total(m)[window].tolist(),
            "standard_errors": z,
            "is_significant": z > CRITERIA.residual_law.min_force_z,
            "unstable_from": m.unstable_from,
        }


def estimate_missing_force(
    fitted: ModelFit,
    data: DiagnosisData,
    window: float = WINDOW_S,
    modes: int = MODES_PER_AXIS,
    progress: Progress = lambda _: None,
) -> MissingForce:
    """Estimate the force beside a fitted model that the episodes ask for.

    Args:
        fitted: a model at its solution.
        data: the episodes that it was fitted to.
        window: time in which the force is constant [s].
        modes: smooth fields over the fabric for each axis.
        progress: called with one line for each episode.
    """
    world = fitted.model.build_world()
    fields = compute_modes(world.cloth.mesh, modes).fields
    responses = [_simulate_response(fitted, data, k, fields, window, progress) for k in range(len(data.episodes))]
    gain, estimate = _estimate_force(responses, fitted, 3 * modes)
    area = torch.as_tensor(world.cloth.mesh.vertex_area).to(fields)
    density = world.cloth.build_model().mass.to(fields)[:, 0] / area  # kg/m^2, where the force acts
    motions, first = [], fitted.linearisation.n_coordinates
    for motion, r, e in zip(data.motions, responses, data.episodes, strict=True):
        index = slice(first, first := first + 3 * modes * len(r.windows))
        mean, std = _expand_estimate(estimate.mean[index], estimate.covariance[index, index], fields)
        windows = torch.stack([e.times[list(w)] - e.times[0] for w in r.windows])
        force, std = (density[:, None] * values for values in (mean, std))
        motions.append(MotionForce(motion, windows, force, std, r.x, r.unstable_from))
    weight = STANDARD_GRAVITY_M_PER_S2 * float((density * area).sum() / area.sum())
    faces = torch.as_tensor(world.cloth.mesh.faces)
    return MissingForce(motions, gain, weight, data.rest_positions[:, :2], faces, area)


class _EpisodeResponse(NamedTuple):
    """Residuals and slopes of one episode, whitened by the noise of a correct model."""

    value: Tensor  # [B]
    slopes: Tensor  # [B, coordinates + W * modes * 3]
    windows: list[tuple[int, int]]
    x: Tensor  # [W, V, 3] m
    unstable_from: float | None  # s, from the first frame


def _simulate_response(
    fitted: ModelFit, data: DiagnosisData, k: int, fields: Tensor, window: float, progress: Progress
) -> _EpisodeResponse:
    e = data.episodes[k]
    progress(f"missing force: {e.name}")
    windows = split_into_windows(e.times, window)
    pulses = ForcePulses(windows, expand_modes(windows, fields))
    frames, derivatives = differentiate_pulses(fitted.model.build_world(), e, pulses, data.dt)
    middle = torch.tensor([(first + last) // 2 for first, last in windows])
    count = _count_stable_bins(e, derivatives)
    value, slopes = whiten_with_force(fitted, data, k, frames, derivatives, count)
    is_unstable = bool((fitted.linearisation.bins[k].window >= count).any())
    return _EpisodeResponse(value, slopes, windows, frames.x[middle], count * BIN_SECONDS if is_unstable else None)


def _count_stable_bins(e: Episode, derivatives: Frames) -> int:
    """Return the time windows of bins before a force first moves the cloth farther than any force could."""
    elapsed = e.times - e.times[0]
    limit = MAX_FREE_FLIGHT_FACTOR * float(elapsed[-1]) ** 2
    is_unstable = ~(derivatives.x.abs().amax((0, 2, 3)) < limit)  # also where it is not a number
    if bool(is_unstable.any()):
        return int(elapsed[is_unstable.nonzero()[0]] / BIN_SECONDS)
    return int(elapsed[-1] / BIN_SECONDS) + 1


def expand_modes(windows: Sequence[tuple[int, int]], fields: Tensor) -> Tensor:
    """Return [W, W * M * 3, V, 3]: every field [M, V] along every axis in every window."""
    count = len(windows)
    unit = torch.einsum("mv,ab->mavb", fields, torch.eye(3).to(fields)).flatten(0, 1)
    return torch.einsum("wu,kvb->wukvb", torch.eye(count).to(fields), unit).flatten(1, 2)


def whiten_with_force(
    fitted: ModelFit, data: DiagnosisData, k: int, frames: Frames, derivatives: Frames, count: int
) -> tuple[Tensor, Tensor]:
    """Whiten the k-th episode's residuals and slopes by the noise of a correct model.

    Args:
        fitted: the model.
        data: the episodes.
        k: index of the episode.
        frames: its simulation.
        derivatives: derivatives of the frames along K directions.
        count: number of time windows; later bins are left out.

    Returns:
        [B] residuals, and [B, coordinates + K] slopes along the model's coordinates, then along the directions.
    """
    e, stds = data.episodes[k], fitted.linearisation.nuisance_stds[k]
    is_stable = fitted.linearisation.bins[k].window < count
    bins = fitted.linearisation.bins[k].select(is_stable)
    max_directions = MAX_SLOPES_AT_ONCE // max(1, sum(map(len, e.clouds)))
    coarse = [
        bin_residuals(frames, some, e, data.surface, data.rest_positions)
        for some in _split_directions(derivatives, max_directions)
    ]
    slopes = torch.cat([align_rows(bins.key, c.key, c.jacobian) for c in coarse], 1)
    noise, _ = reference_noise(bins, fitted.linearisation.mesh_differences[k][is_stable])
    factor = torch.linalg.cholesky(noise.covariance(bins, bins.jacobian[:, -len(stds) :], stds))
    n_coordinates = fitted.linearisation.n_coordinates
    columns = torch.cat([bins.value[:, None], bins.jacobian[:, :n_coordinates], slopes], 1)
    columns = torch.linalg.solve_triangular(factor, columns, upper=False)
    return columns[:, 0], columns[:, 1:]


def _split_directions(derivatives: Frames, max_directions: int) -> Iterator[Frames]:
    max_directions, count = max(max_directions, 1), len(derivatives.x)
    for first in range(0, count, max_directions):
        yield map_frames(derivatives, lambda d, some=slice(first, first + max_directions): d[some])


class _Posterior(NamedTuple):
    """Coordinates of the model, then of every episode's windows, fields and axes."""

    log_likelihood: Tensor  # up to a constant
    mean: Tensor
    covariance: Tensor


def _estimate_force(
    responses: Sequence[_EpisodeResponse], fitted: ModelFit, per_window: int
) -> tuple[float, _Posterior]:
    """Return (gain in log-likelihood over no force, the force).

    First one prior for all windows is chosen, then one for each window of ``per_window`` numbers (MacKay 1992), because
    most windows have no force.
    """
    n_coordinates = fitted.linearisation.n_coordinates
    force_slopes = torch.block_diag(*(r.slopes[:, n_coordinates:] for r in responses))
    slopes = torch.cat([torch.cat([r.slopes[:, :n_coordinates] for r in responses]), force_slopes], 1)
    precision = prior_precision(fitted.model)
    information, score = slopes.mT @ slopes, slopes.mT @ torch.cat([r.value for r in responses])
    score[:n_coordinates] += precision * fitted.model.point

    def solve(stds: Tensor) -> _Posterior:
        return _solve_posterior(information, score, precision, stds.repeat_interleave(per_window))

    count = force_slopes.shape[1] // per_window
    uniform = [solve(std.expand(count)) for std in FIELD_STDS_M_PER_S2]
    best = max(range(len(uniform)), key=lambda i: float(uniform[i].log_likelihood))
    estimate, min_std = uniform[best], float(FIELD_STDS_M_PER_S2[0])
    for _ in range(WINDOW_SWEEPS):
        square = estimate.mean[n_coordinates:] ** 2 + estimate.covariance.diagonal()[n_coordinates:]
        estimate = solve(square.reshape(count, per_window).mean(1).sqrt().clamp(min=min_std))
    none = solve(NEGLIGIBLE_FORCE_FACTOR * FIELD_STDS_M_PER_S2[0].expand(count))
    return float(estimate.log_likelihood - none.log_likelihood), estimate


def _solve_posterior(information: Tensor, score: Tensor, precision: Tensor, stds: Tensor) -> _Posterior:
    """Solve in units of the prior, where no direction is undetermined: stds may differ by many orders."""
    unit = torch.cat([precision.rsqrt(), stds])
    square = unit[:, None] * information * unit + torch.eye(len(unit)).to(information)
    square.diagonal().add_(torch.finfo(square.dtype).eps * square.diagonal().sum())  # rounding errors
    factor = torch.linalg.cholesky(square)
    mean = -unit * torch.cholesky_solve((unit * score)[:, None], factor)[:, 0]
    log_likelihood = -0.5 * score @ mean - factor.diagonal().log().sum() - 0.5 * precision.log().sum()
    return _Posterior(log_likelihood, mean, unit[:, None] * torch.cholesky_inverse(factor) * unit)


def _expand_estimate(mean: Tensor, covariance: Tensor, fields: Tensor) -> tuple[Tensor, Tensor]:
    """Return (mean, standard error) [W, V, 3] m/s^2 from numbers of windows, fields and axes."""
    per_window = 3 * len(fields)
    numbers = mean.reshape(-1, len(fields), 3)
    blocks = torch.stack([covariance[s : s + per_window, s : s + per_window] for s in range(0, len(mean), per_window)])
    blocks = blocks.reshape(-1, len(fields), 3, len(fields), 3)
    variance = torch.einsum("wmana,mv,nv->wva", blocks, fields, fields)
    return torch.einsum("wma,mv->wva", numbers, fields), variance.clamp(min=1e-30).sqrt()
