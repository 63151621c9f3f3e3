"""Where, when and in which direction a force is missing.

A pressure that is smooth over the fabric and constant within ``WINDOW`` is asked for beside the model: the likeliest
one under a prior whose size the data set (weak-constraint variational assimilation, Tremolet 2006), beside the noise
that a right model would leave (``lacking.reference``). Tangents along all directions cost about as much as the
adjoint's twenty passes of conjugate gradients, and give its errors too. Where the motion is unstable they grow without
end: from there on folds decide, and nothing is asked.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ...episodes.observed import Episode
from ...episodes.replay import Frames
from ...episodes.replay import each as of_each
from ...pose.modes import modes_of
from ...pose.objective import windows_of
from ..data.binning import BIN_SECONDS, align_rows, bin_residuals
from ..data.dataset import Progress, DiagnosisData
from ..inference.fitting import ModelFit, prior_precision
from ..inference.lack_of_fit import reference_noise
from .force_sensitivities import ForcePulses, differentiate_pulses

WINDOW, MODES = 0.2, 8  # s, fields for each axis
LEVELS = 10 ** torch.linspace(-2.5, 1.5, 41, dtype=torch.float64)  # m/s^2, prior standard deviation of a field
SWEEPS = 15  # of learning the size window by window
GRAVITY = 9.81  # m/s^2
FARTHEST = 10.0  # times the square of a motion's duration, that 1 m/s^2 may move the cloth: free flight has half of it
AT_ONCE = 100_000_000  # slopes of points, 0.8 GB: of long motions they would fill the memory
SURE = 4.0  # standard errors; a chi of three numbers exceeds it once in 900 places


class MotionForce(NamedTuple):
    """The missing force in one motion."""

    motion: str
    windows: Tensor  # [W, 2] s, from the first frame
    force: Tensor  # [W, V, 3] Pa, world axes
    std: Tensor  # [W, V, 3] Pa
    x: Tensor  # [W, V, 3] m, where the cloth is in the middle of each
    unstable_from: float | None  # s, from the first frame: from then on pushes grow without end, and nothing was asked

    @property
    def certainty(self) -> Tensor:
        """[W, V] standard errors by which the force differs from zero."""
        return (self.force / self.std).norm(dim=-1)

    @property
    def strongest(self) -> tuple[int, int]:
        """(window, vertex) where it is the most certain."""
        place = int(self.certainty.argmax())
        return place // self.force.shape[1], place % self.force.shape[1]


@dataclass(frozen=True, eq=False)
class MissingForce:
    """In all motions.

    Attributes:
        parts: one for each episode.
        gain: log-likelihood of a missing force over none.
        weight: Pa, of the cloth.
        uv: [V, 2] m, the pattern.
        faces: [F, 3].
        area: [V] m^2.
    """

    motions: Sequence[MotionForce]
    gain: float
    weight: float
    uv: Tensor
    faces: Tensor
    area: Tensor

    def total(self, m: MotionForce) -> Tensor:
        """[W, 3] N, sum over the cloth."""
        return (m.force * self.area[:, None]).sum(1)

    def as_dict(self) -> dict[str, Any]:
        """The content of diagnosis.json: when the force is the most certain and what pushes alike then, by motion."""
        return {"weight": self.weight, "gain": self.gain, "motions": [self._told(m) for m in self.motions]}

    def _told(self, m: MotionForce) -> dict[str, Any]:
        w, v = m.strongest
        alike = (m.force[w] @ m.force[w, v] / m.force[w, v].norm().clamp(min=1e-30)).clamp(min=0.0)
        weight = alike.square() * self.area  # what pushes the other way has its middle elsewhere
        share = weight / weight.sum().clamp(min=1e-30)  # of a motion without cells there is no force
        middle, pressure = ((share[:, None] * of).sum(0) for of in (self.uv, m.force[w]))
        if alike[(self.uv - middle).norm(dim=1).argmin()] <= 0.5 * alike[v]:  # it lies between two places
            middle = self.uv[v]
        certain = float(m.certainty[w].max())
        return {
            "motion": m.motion,
            "rms": float(m.force.square().sum(-1).mean().sqrt()),
            "at": middle.tolist(),
            "from": float(m.windows[w, 0]),
            "to": float(m.windows[w, 1]),
            "pressure": pressure.tolist(),
            "total": self.total(m)[w].tolist(),
            "standard_errors": certain,
            "sure": certain > SURE,
            "until": m.unstable_from,
        }


def missing_force(
    found: ModelFit,
    setting: DiagnosisData,
    window: float = WINDOW,
    modes: int = MODES,
    progress: Progress = lambda _: None,
) -> MissingForce:
    """The force beside a fitted model that the episodes of its setting ask for.

    Args:
        found: a model at its solution.
        setting: the episodes that it was fitted to.
        window: of time [s], in which the force is constant.
        modes: smooth fields over the fabric for each axis.
        progress: called with one line for each episode.
    """
    world = found.model.world()
    fields = modes_of(world.cloth.mesh, modes).fields
    parts = [_asked(found, setting, k, fields, window, progress) for k in range(len(setting.episodes))]
    gain, answer = _likeliest(parts, found, 3 * modes)
    area = torch.as_tensor(world.cloth.mesh.vertex_area).to(fields)
    density = world.cloth.build_model().mass.to(fields)[:, 0] / area  # kg/m^2 where it pushes
    told, first = [], found.linearisation.n_coordinates
    for name, p, e in zip(setting.motions, parts, setting.episodes, strict=True):
        here = slice(first, first := first + 3 * modes * len(p.windows))
        force, std = (density[:, None] * f for f in _spread(answer.mean[here], answer.covariance[here, here], fields))
        windows = torch.stack([e.times[list(w)] - e.times[0] for w in p.windows])
        told.append(MotionForce(name, windows, force, std, p.x, p.until))
    weight = GRAVITY * float((density * area).sum() / area.sum())
    return MissingForce(told, gain, weight, setting.rest_positions[:, :2], torch.as_tensor(world.cloth.mesh.faces), area)


class _Asked(NamedTuple):
    """Of one episode, in units in which what a right model leaves is white."""

    value: Tensor  # [C]
    slopes: Tensor  # [C, own + W * M * 3]
    windows: list[tuple[int, int]]
    x: Tensor  # [W, V, 3]
    until: float | None  # s, from the first frame


def _asked(found: ModelFit, setting: DiagnosisData, k: int, fields: Tensor, window: float, progress: Progress) -> _Asked:
    e = setting.episodes[k]
    progress(f"{e.name}: missing force")
    windows = windows_of(e.times, window)
    frames, moved = differentiate_pulses(found.model.world(), e, ForcePulses(windows, expand_modes(windows, fields)), setting.dt)
    middle = torch.tensor([(first + last) // 2 for first, last in windows])
    count = _foreseen(e, moved)
    value, slopes = whiten_with_force(found, setting, k, frames, moved, count)
    unasked = bool((found.linearisation.bins[k].window >= count).any())
    return _Asked(value, slopes, windows, frames.x[middle], count * BIN_SECONDS if unasked else None)


def _foreseen(e: Episode, moved: Frames) -> int:
    """Stretches of time of the cells before the first in which a push moves the cloth farther than any could."""
    since = e.times - e.times[0]
    far = ~(moved.x.abs().amax((0, 2, 3)) < FARTHEST * float(since[-1]) ** 2)  # not a number is far
    return int(since[far.nonzero()[0]] / BIN_SECONDS) if bool(far.any()) else int(since[-1] / BIN_SECONDS) + 1


def expand_modes(windows: Sequence[tuple[int, int]], fields: Tensor) -> Tensor:
    """[W, W * M * 3, V, 3]: every field [M, V] along every axis in every window."""
    count = len(windows)
    unit = torch.einsum("mv,ab->mavb", fields, torch.eye(3).to(fields)).flatten(0, 1)
    return torch.einsum("wu,kvb->wukvb", torch.eye(count).to(fields), unit).flatten(1, 2)


def whiten_with_force(
    found: ModelFit, setting: DiagnosisData, k: int, frames: Frames, moved: Frames, count: int
) -> tuple[Tensor, Tensor]:
    """(residuals [C], slopes [C, own + K]) along the model's own coordinates, then along ``moved``; both whitened.

    Of cells in the first ``count`` stretches of time.
    """
    e, stds, told = setting.episodes[k], found.linearisation.nuisance_stds[k], found.linearisation.bins[k].window < count
    cells = found.linearisation.bins[k].select(told)
    most = AT_ONCE // max(1, sum(map(len, e.clouds)))
    coarse = [bin_residuals(frames, some, e, setting.sheet, setting.rest_positions) for some in _divided(moved, most)]
    slopes = torch.cat([align_rows(cells.key, c.key, c.jacobian) for c in coarse], 1)
    noise, _ = reference_noise(cells, found.linearisation.mesh_differences[k][told])
    root = torch.linalg.cholesky(noise.covariance(cells, cells.jacobian[:, -len(stds) :], stds))
    both = torch.cat([cells.value[:, None], cells.jacobian[:, : found.linearisation.n_coordinates], slopes], 1)
    both = torch.linalg.solve_triangular(root, both, upper=False)
    return both[:, 0], both[:, 1:]


def _divided(moved: Frames, most: int) -> Iterator[Frames]:
    """So many directions at a time."""
    most, count = max(most, 1), len(moved.x)
    for first in range(0, count, most):
        yield of_each(moved, lambda d, some=slice(first, first + most): d[some])


class _Found(NamedTuple):
    """Numbers of the model, then of every episode's windows, fields and axes."""

    log: Tensor  # likelihood, up to a constant
    mean: Tensor
    covariance: Tensor


def _likeliest(parts: Sequence[_Asked], found: ModelFit, each: int) -> tuple[float, _Found]:
    """(gain in log-likelihood over no force, the force).

    First one size for all that is pushed, then one for each window, of ``each`` numbers (MacKay 1992): most are still.
    """
    own = found.linearisation.n_coordinates
    pushes = torch.block_diag(*(p.slopes[:, own:] for p in parts))
    slopes = torch.cat([torch.cat([p.slopes[:, :own] for p in parts]), pushes], 1)
    known = prior_precision(found.model)
    information, asked = slopes.mT @ slopes, slopes.mT @ torch.cat([p.value for p in parts])
    asked[:own] += known * found.model.point
    ask = lambda sizes: _posterior(information, asked, known, sizes.repeat_interleave(each))  # noqa: E731
    count = pushes.shape[1] // each
    tried = [ask(level.expand(count)) for level in LEVELS]
    best = max(range(len(tried)), key=lambda i: float(tried[i].log))
    answer, sizes = tried[best], LEVELS[best].expand(count)
    for _ in range(SWEEPS):
        spread = answer.mean[own:] ** 2 + answer.covariance.diagonal()[own:]
        sizes = spread.reshape(count, each).mean(1).sqrt().clamp(min=float(LEVELS[0]))
        answer = ask(sizes)
    return float(answer.log - ask(1e-3 * LEVELS[0].expand(count)).log), answer


def _posterior(information: Tensor, asked: Tensor, known: Tensor, sizes: Tensor) -> _Found:
    """In units of the prior, where no direction is unknown: what is asked for may reach over many orders."""
    unit = torch.cat([known.rsqrt(), sizes])
    square = unit[:, None] * information * unit + torch.eye(len(unit)).to(information)
    square.diagonal().add_(torch.finfo(square.dtype).eps * square.diagonal().sum())  # what rounding may have taken
    root = torch.linalg.cholesky(square)
    mean = -unit * torch.cholesky_solve((unit * asked)[:, None], root)[:, 0]
    log = -0.5 * asked @ mean - root.diagonal().log().sum() - 0.5 * known.log().sum()
    return _Found(log, mean, unit[:, None] * torch.cholesky_inverse(root) * unit)


def _spread(mean: Tensor, covariance: Tensor, fields: Tensor) -> tuple[Tensor, Tensor]:
    """(mean, standard error) [W, V, 3] m/s^2 from numbers of windows, fields and axes."""
    each = 3 * len(fields)
    numbers = mean.reshape(-1, len(fields), 3)
    blocks = torch.stack([covariance[s : s + each, s : s + each] for s in range(0, len(mean), each)])
    blocks = blocks.reshape(-1, len(fields), 3, len(fields), 3)
    variance = torch.einsum("wmana,mv,nv->wva", blocks, fields, fields)
    return torch.einsum("wma,mv->wva", numbers, fields), variance.clamp(min=1e-30).sqrt()
