"""``estimate_pose``: the full mesh over time from a recording that shows a part of it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from .._utils.linalg import last_knot
from .._utils.torch_modes import own_gradients
from ..boundaries import Grasp
from ..cloth import Cloth
from ..episodes.observed import Episode, episode, on_cpu
from ..episodes.unknowns import collect, with_priors
from ..errors import InvalidInput, RecordingError
from ..identification.nuisances import chosen, foreseen, implied
from ..identification.residuals.blocks import blocks_for
from ..identification.residuals.metrics import LEAST_SCALE, figures
from ..identification.residuals.rigid_carry import rigid_carry
from ..identification.uncertainty.reporting import estimates, nuisance_estimates
from ..recordings import Recording
from ..recordings.consistency import check_recording
from ..recordings.size_checks import check_size
from .fine_scale_uncertainty import unexplained
from .modes import Modes, check_count, modes_of
from .objective import Corrected, Correction, pushable, windows_of
from .result import PoseEstimate
from .smoothing import Smoothed, smooth
from .visibility import seen_vertices
from .warnings import warnings_of

FIRST_GUESS = 0.5  # m/s^2, of the corrective force; its size is then learnt from the recording

Progress = Callable[[str, float], None]


@own_gradients()
def estimate_pose(
    cloth: Cloth,
    recording: Recording,
    *,
    uncertain: Mapping[str, tuple[float, float]] | None = None,
    window: float = 0.15,
    modes: int = 8,
    nuisances: Mapping[str, float | None] | Sequence[str] = (),
    use: Sequence[str] | None = None,
    noise: Mapping[str, float] | None = None,
    dt: float | None = None,
    on_progress: Progress | None = None,
) -> PoseEstimate:
    """Where every vertex of a cloth was at every frame of a recording, hidden ones included, with standard errors.

    The cloth is simulated along the recorded motion and pushed by a small extra force: constant within each window of
    time, smooth over the fabric, world axes. All windows' forces are found together by Gauss-Newton on the residuals
    that ``identify`` uses, against a prior whose size is learnt from the recording: a smoother in the sense of weak-
    constraint variational assimilation (Tremolet 2006). The result is one continuous motion: position, velocity and
    memory go from window to window as the simulation leaves them. In the first window the force also acts while the
    cloth comes to rest before the first frame.

    Args:
        cloth: the model, with fitted (``Identification.apply``) or nominal values; left unchanged.
        recording: one episode of it.
        uncertain: fabric parameters that are known with an error, (value, factor) for positive ones, (value, standard
            deviation) for others, as the priors of ``identify``: they are corrected beside the force, and their
            errors are part of the result's.
        window: of time [s] in which the force is constant.
        modes: smooth fields over the fabric for each axis of the force.
        nuisances: as in ``identify``: "clock", "camera", "grasp", "shape".
        use: kinds of data, some of "points", "markers" and "force"; None: all that the recording has.
        noise: least standard deviation by kind of data, as in ``identify``.
        dt: largest substep [s]; None: the stable one.
        on_progress: called with (stage, share of the corrective force so far).

    Returns:
        Frames with standard errors, visibility, forces, warnings.

    Raises:
        InvalidInput: options out of range, or a cloth that has an effect "correction" already.
        RecordingError: a recording without motion, or with nothing seen or felt.
        SimulationDiverged: the cloth cannot be simulated with these values.
    """
    began = time.perf_counter()
    if not (math.isfinite(window) and window > 0):
        raise InvalidInput("window", got=window, expected="a time > 0 in s")
    on_cpu(cloth)
    check_recording(recording)
    check_size(recording)
    check_count(cloth.mesh, modes)
    data, fields = episode(cloth, recording), modes_of(cloth.mesh)
    coarse = fields.fields[:modes].to(data.initial)
    density = recording.cloth.weighed if uncertain else None
    unknowns = with_priors(collect(cloth, list(uncertain or {}), density), uncertain or {})
    blocks = blocks_for(use)
    own = chosen(nuisances, implied([block.name for block in blocks], [data]))
    windows, (data,) = windows_of(data.times, window), foreseen([data], own)
    windows[-1] = (windows[-1][0], len(data.times) - 1)  # what a late clock sees is pushed as the last frame is
    correction = Correction(windows, coarse, torch.full((modes,), FIRST_GUESS))
    objective = Corrected(pushable(cloth), unknowns, data, correction, dt, own, blocks, noise)
    if not objective.told:
        kinds = "any" if use is None else ", ".join(use)
        got = f"no data of {kinds} kind in any frame"
        raise RecordingError(f"{data.name}: nothing to estimate from", got=got, expected="points, markers or forces")
    gravity = float(torch.as_tensor(recording.gravity).norm()) or 9.81
    always = held_at(cloth, data).all(0)

    def tell(stage: str, raw: Tensor) -> None:
        if on_progress is not None:
            on_progress(stage, _over_time(objective, _shares(objective, raw, always, gravity)))

    found = smooth(objective, tell)
    return _concluded(objective, found, fields, gravity, began)


def _concluded(objective: Corrected, found: Smoothed, fields: Modes, gravity: float, began: float) -> PoseEstimate:
    data, cloth, raw = objective.episodes[0].until(1.0), objective.cloth, found.raw
    used = objective.used.until(1.0)
    ends = [data.times[[first, min(last, data.observed - 1)]] for first, last in objective.correction.windows]
    with torch.no_grad():
        frames, moved = objective.tangents(raw)
        x, v, along = frames.x[: data.observed], frames.v[: data.observed], moved.x[:, : data.observed]
        alone, null = objective.frames(objective.start)[0][: data.observed], rigid_carry(data)
        held = held_at(cloth, data)
        std = _errors(objective, used, found, x, along, fields, held)
        last = objective.last_state(raw)
    seen, shares = seen_vertices(x, used, cloth.mesh), _shares(objective, raw, held.all(0), gravity)
    fit = _distances(data, objective.faces, {"after": x, "alone": alone, "null": null})
    fit |= {
        "force_share": _over_time(objective, shares),
        "force_share_max": float(shares.max()),
        "seen_share": float(seen.double().mean()),
        "std_rms": float(std.square().sum(-1).mean().sqrt()),
        "point_noise": _point_noise(objective, used, found),
        "converged": found.converged,
        "unknowns": len(raw),
        "seconds": time.perf_counter() - began,
    }
    fabric = estimates(cloth, objective.unknowns, raw, found.covariance).parameters
    return PoseEstimate(
        times=data.times,
        x=x,
        v=v,
        std=std,
        seen=seen,
        faces=objective.faces,
        windows=torch.stack(ends),
        acceleration=objective.correction.field(raw[objective.pushes]),
        shares=shares,
        alone=alone,
        null=null,
        last=last,
        parameters={u.name: fabric[u.name] for u in objective.unknowns},
        nuisances=next(iter(nuisance_estimates([data], objective.placed, raw, found.covariance).values())),
        fit=fit,
        warnings=warnings_of(fit, shares, seen, used, ends, _stated(objective, used), found.holds)
        + fields.doubt(len(objective.correction.modes)),
    )


def _distances(data: Episode, faces: Tensor, frames: Mapping[str, Tensor]) -> dict[str, Any]:
    found = {key: figures([x], [data], faces) for key, x in frames.items()}
    return {f"{what}_{key}": getattr(f, what) for what in ("chamfer", "rms") for key, f in found.items()}


def _point_noise(objective: Corrected, used: Episode, found: Smoothed) -> float:
    """m, standard deviation of the points beside the estimate; NaN where none were used."""
    names = [block.name for block in objective.blocks]
    return float(found.final.scale[names.index("points")]) if any(map(len, used.clouds)) else math.nan


def _stated(objective: Corrected, used: Episode) -> float | None:
    """m, standard deviation of a point as it was given; None: nobody did."""
    return objective.floors.get("points", used.noise)


def _errors(
    objective: Corrected, used: Episode, found: Smoothed, x: Tensor, moved: Tensor, fields: Modes, held: Tensor
) -> Tensor:
    """[T, V, 3] m, of what was estimated, and of what is finer than it."""
    root = found.root.to(moved)
    variance = torch.stack([(root.mT @ frame.flatten(1)).square().sum(0) for frame in moved.unbind(1)])
    stated = _stated(objective, used)
    least, usual = stated or LEAST_SCALE, stated or _point_noise(objective, used, found)
    coarse = len(objective.correction.modes)
    finer = unexplained(x, used, objective.faces, fields, coarse, held, least, usual)
    return (variance.reshape(x.shape) + finer.square().unsqueeze(-1)).sqrt()


def held_at(cloth: Cloth, data: Episode) -> Tensor:
    """[T, V] bool, whether a closed gripper has the vertex at an observed frame."""
    out = torch.zeros(data.observed, len(cloth.mesh.vertices), dtype=torch.bool)
    for name, part in cloth.boundaries.items():
        if isinstance(part, Grasp):
            motion = data.motion[name]
            closed = motion.closed[last_knot(motion.t, data.times[: data.observed] + 1e-9).clamp(min=0)]
            out[:, part.index] |= closed[:, None]
    return out


def _over_time(objective: Corrected, shares: Tensor) -> float:
    """Root mean square of shares [W]: windows last as long as the gaps between frames make them."""
    times = objective.episodes[0].times
    lasts = torch.stack([times[last] - times[first] for first, last in objective.correction.windows]).to(shares)
    return float(((shares.square() * lasts).sum() / lasts.sum()).sqrt())


def _shares(objective: Corrected, raw: Tensor, held: Tensor, gravity: float) -> Tensor:
    """[W] of the force in the weight, rms by mass over the cloth that is not ``held`` [V] all the time."""
    squared = objective.correction.field(raw[objective.pushes]).square().sum(-1)
    mass = objective.cloth.model().mass.detach().squeeze(-1).to(squared) * ~held
    return ((squared * mass).sum(-1) / mass.sum()).sqrt() / gravity
