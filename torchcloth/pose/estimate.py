"""``estimate_pose``: the full mesh over time from a recording that shows a part of it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal, cast

import numpy as np
import torch
from torch import Tensor

from .._utils.constants import STANDARD_GRAVITY_M_PER_S2
from .._utils.linalg import find_last_knot
from .._utils.torch_modes import isolated_grad_mode
from ..boundaries import Grasp
from ..cloth import Cloth
from ..episodes.observed import TIME_AFTER_KNOT_S, Episode, build_episode, require_cpu
from ..episodes.unknowns import apply_priors, collect_unknowns
from ..errors import InvalidInput, RecordingError
from ..identification.estimators.objective import Objective
from ..identification.nuisances import (
    FirstStateOffset,
    GripExtent,
    StampJitter,
    add_lookahead,
    as_stds,
    implied_nuisances,
    select_nuisances,
)
from ..identification.residuals.blocks import select_blocks
from ..identification.residuals.metrics import MIN_NOISE_SCALE, distance_metrics
from ..identification.residuals.rigid_carry import carry_rigidly
from ..identification.uncertainty.consider_covariance import CONSIDERED_GRIP_STD_M, with_grasp_offsets
from ..identification.uncertainty.estimates import make_estimates, make_nuisance_estimates
from ..inspection.corrections import check_all
from ..meshes.mesh import vertex_normals
from ..recordings import Recording
from ..recordings.consistency import check_recording
from ..recordings.size_checks import check_size
from .fine_scale_uncertainty import estimate_fine_scale_std
from .first_shape import estimate_first_shape, load_network
from .modes import Modes, check_mode_count, compute_modes
from .network import PoseEstimator
from .network_answers import add_network_answers
from .objective import CorrectedObjective, CorrectiveForce, add_correction_effect, split_into_windows
from .result import PoseEstimate
from .smoothing import SmoothedPose, smooth
from .visibility import find_seen_vertices
from .warnings import pose_warnings

# A depth camera is off by patches, slowly, and the estimate follows it: by a millimetre at a metre at least, and by
# more than its points scatter: Kinect and calibrated stereo scatter by 2 mm, and are off by some 5 mm.
SLOW_DEPTH_ERROR_STD_M, SLOW_DEPTH_ERROR_RATIO = 1e-3, 2.0
IDENTIFY_ONLY_NUISANCES = {GripExtent.name, StampJitter.name}
INITIAL_FORCE_STD_M_PER_S2 = 0.5  # of the corrective force; its size is then learnt from the recording

Progress = Callable[[str, float], None]


@isolated_grad_mode()
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
    checks: bool = True,
    start: Literal["recording", "network"] | PoseEstimator = "recording",
) -> PoseEstimate:
    """Estimate where every vertex of a cloth was at every frame of a recording, hidden ones included.

    The cloth is simulated along the recorded motion and pushed by a small corrective force, which is constant within
    each window of time, smooth over the fabric, and in world axes. Gauss-Newton finds all windows' forces together, on
    the residuals that ``identify`` uses, against a prior whose size is learnt from the recording. This is a smoother in
    the sense of weak-constraint variational assimilation (Tremolet 2006). The result is one continuous motion:
    position, velocity and memory go from window to window as the simulation leaves them. In the first window the force
    also acts while the cloth comes to rest before the first frame.

    Args:
        cloth: the model, with fitted (``Identification.apply``) or nominal values; left unchanged.
        recording: one episode of it.
        uncertain: fabric parameters that are known with an error, (value, factor) for positive ones, (value, standard
            deviation) for others, as the priors of ``identify``. They are corrected together with the force, and their
            errors are part of the result's.
        window: duration in which the force is constant [s].
        modes: number of smooth fields over the fabric for each axis of the force.
        nuisances: as in ``identify``, without "grip" and "jitter": "clock", "camera", "grasp", "grasp_turn", "shape",
            "velocity". Where the cloth moves at the first frame, the last two join, in as many fields as the force has.
        use: kinds of data, some of "points", "markers" and "force"; None: all that the recording has.
        noise: least standard deviation by kind of data, as in ``identify``.
        dt: largest substep [s]; None: the stable one.
        on_progress: called with (stage, corrective force so far as a fraction of the weight).
        checks: look for frozen clouds and for a clock that is off, as ``identify`` does (``inspection.corrections``).
            The result has no frames where clouds were frozen. A clock that is off is corrected, and becomes a nuisance.
        start: where the first shape comes from: the recording; the shipped network (`estimate_first_shape`), which also
            tells how fast the cloth moves; or a network of one's own. A network's shape is a start: the nuisances
            "shape", with its error, "grasp" and "grasp_turn" are added. Its answers to all clouds count as data, unless
            ``use`` says what counts.

    Returns:
        Frames with standard errors, visibility, forces, warnings.

    Raises:
        InvalidInput: options out of range, an unknown start, or a cloth that has an effect "correction" already.
        RecordingError: a recording without motion, or without data.
        SimulationDiverged: the cloth cannot be simulated with these values.
    """
    began = time.perf_counter()
    if not (math.isfinite(window) and window > 0):
        raise InvalidInput("window", got=window, expected="a time > 0 in s")
    require_cpu(cloth)
    check_recording(recording)
    check_size(recording)
    notes, nuisances = [], as_stds(nuisances)
    if unknown := sorted(IDENTIFY_ONLY_NUISANCES & nuisances.keys()):
        raise InvalidInput(
            "nuisances",
            got=", ".join(unknown),
            expected="none of these, which only identify knows",
            remedy='clock, camera, grasp, grasp_turn and shape say what may be off: "clock" instead of "jitter"',
        )
    if checks:
        (recording,), notes, clock_std = check_all([recording])
        nuisances = nuisances if clock_std is None else {"clock": clock_std, **nuisances}
    if start != "recording":
        network = _network_of(start)
        shape = estimate_first_shape(cloth, recording, network)
        recording, notes = shape.apply(recording), [*notes, *shape.warnings]
        nuisances = {"shape": shape.std_rms, "grasp": CONSIDERED_GRIP_STD_M, "grasp_turn": None, **nuisances}
        if recording.markers is None and use is None and cloth.mesh.uv is not None:
            recording, std = add_network_answers(cloth, recording, network)
            noise = {"markers": std, **(noise or {})}
    check_mode_count(cloth.mesh, modes)
    episode, all_modes = build_episode(cloth, recording), compute_modes(cloth.mesh)
    fields = all_modes.fields[:modes].to(episode.initial)
    weighed = recording.cloth.measured_areal_density if uncertain else None
    unknowns = apply_priors(collect_unknowns(cloth, list(uncertain or {}), weighed), uncertain or {})
    blocks = select_blocks(use)
    implied = implied_nuisances([block.name for block in blocks], [episode])
    selected = select_nuisances(nuisances, implied)
    if episode.initial_velocity is not None:
        selected = [n.with_fields(fields) if isinstance(n, FirstStateOffset) else n for n in selected]
    windows, (episode,) = split_into_windows(episode.times, window), add_lookahead([episode], selected)
    windows[-1] = (windows[-1][0], len(episode.times) - 1)  # frames for a late clock are pushed as the last one is
    force = CorrectiveForce(windows, fields, torch.full((modes,), INITIAL_FORCE_STD_M_PER_S2))
    objective = CorrectedObjective(add_correction_effect(cloth), unknowns, episode, force, dt, selected, blocks, noise)
    if not objective.has_data:
        kinds = "any" if use is None else ", ".join(use)
        got = f"no data of {kinds} kind in any frame"
        raise RecordingError(f"{episode.name}: nothing to estimate from", got=got, expected="points, markers or forces")
    gravity = float(torch.as_tensor(recording.gravity).norm()) or STANDARD_GRAVITY_M_PER_S2
    is_always_gripped = find_gripped_vertices(cloth, episode).all(0)

    def report(stage: str, raw: Tensor) -> None:
        if on_progress is not None:
            on_progress(stage, _rms_over_time(objective, _force_fractions(objective, raw, is_always_gripped, gravity)))

    estimate = _assemble_result(objective, smooth(objective, report), all_modes, gravity, began)
    return replace(estimate, warnings=[*notes, *estimate.warnings])


def _network_of(start: str | PoseEstimator) -> PoseEstimator:
    if isinstance(start, str) and start != "network":
        raise InvalidInput("start", got=repr(start), expected="'recording', 'network' or a PoseEstimator")
    return load_network() if isinstance(start, str) else start


def _assemble_result(
    objective: CorrectedObjective, smoothed: SmoothedPose, all_modes: Modes, gravity: float, began: float
) -> PoseEstimate:
    episode, cloth, raw = objective.episodes[0].first_fraction(1.0), objective.cloth, smoothed.raw
    used, count = objective.used_data.first_fraction(1.0), episode.observed_count
    windows = [episode.times[[first, min(last, count - 1)]] for first, last in objective.force.windows]
    with torch.no_grad():
        wider, is_considered = with_grasp_offsets(objective)
        wider_raw = wider.start.clone()
        wider_raw[~is_considered] = raw
        frames, derivatives = cast("CorrectedObjective", wider).simulate_with_tangents(wider_raw)
        x, v, slopes = frames.x[:count], frames.v[:count], derivatives.x[:, :count]
        uncorrected = objective.simulate_vertices(objective.start)[0][:count]
        rigid = carry_rigidly(episode)
        is_gripped = find_gripped_vertices(cloth, episode)
        considered = _considered_slopes(wider, wider_raw, is_considered, smoothed, slopes)
        std = _standard_errors(objective, used, smoothed, x, slopes[~is_considered], considered, all_modes, is_gripped)
        last_state = objective.last_state(raw)
    seen = find_seen_vertices(x, used, cloth.mesh)
    force_fractions = _force_fractions(objective, raw, is_gripped.all(0), gravity)
    fit = _distance_entries(episode, objective.faces, {"after": x, "uncorrected": uncorrected, "null": rigid})
    fit |= {
        "force_fraction": _rms_over_time(objective, force_fractions),
        "force_fraction_max": float(force_fractions.max()),
        "seen_fraction": float(seen.double().mean()),
        "std_rms": float(std.square().sum(-1).mean().sqrt()),
        "point_noise": _point_noise(objective, used, smoothed),
        "converged": smoothed.converged,
        "unknowns": len(raw),
        "seconds": time.perf_counter() - began,
    }
    estimates = make_estimates(cloth, objective.unknowns, raw, smoothed.covariance).parameters
    nuisances = make_nuisance_estimates([episode], objective.nuisance_slices, raw, smoothed.covariance)
    warnings = pose_warnings(
        fit, force_fractions, seen, used, windows, _stated_noise(objective, used), smoothed.predictable_frames
    )
    return PoseEstimate(
        times=episode.times,
        x=x,
        v=v,
        std=std,
        seen=seen,
        faces=objective.faces,
        windows=torch.stack(windows),
        acceleration=objective.force.acceleration_field(raw[objective.force_slice]),
        force_fractions=force_fractions,
        uncorrected=uncorrected,
        rigid_carry=rigid,
        last_state=last_state,
        parameters={u.name: estimates[u.name] for u in objective.unknowns},
        nuisances=next(iter(nuisances.values())),
        fit=fit,
        warnings=warnings + all_modes.truncation_warnings(len(objective.force.modes)),
    )


def _distance_entries(episode: Episode, faces: Tensor, frames: Mapping[str, Tensor]) -> dict[str, Any]:
    metrics = {key: distance_metrics([x], [episode], faces) for key, x in frames.items()}
    return {f"{what}_{key}": getattr(m, what) for what in ("chamfer", "rms") for key, m in metrics.items()}


def _point_noise(objective: CorrectedObjective, used: Episode, smoothed: SmoothedPose) -> float:
    """Standard deviation of the points about the estimate [m]; NaN where none were used."""
    names = [block.name for block in objective.blocks]
    return float(smoothed.final.scale[names.index("points")]) if any(map(len, used.clouds)) else math.nan


def _stated_noise(objective: CorrectedObjective, used: Episode) -> float | None:
    """Standard deviation of a point as it was stated [m]; None where it was not."""
    return objective.noise_floors.get("points", used.noise_std)


def _standard_errors(
    objective: CorrectedObjective,
    used: Episode,
    smoothed: SmoothedPose,
    x: Tensor,
    slopes: Tensor,
    considered: Tensor,
    all_modes: Modes,
    is_gripped: Tensor,
) -> Tensor:
    """[T, V, 3] m, of the unknowns, of grips, of shapes finer than the force's modes, and of slow errors of depth."""
    root = smoothed.covariance_root.to(slopes)
    variance = torch.stack([(root.mT @ frame.flatten(1)).square().sum(0) for frame in slopes.unbind(1)])
    stated = _stated_noise(objective, used)
    noise_floor, default_noise = stated or MIN_NOISE_SCALE, stated or _point_noise(objective, used, smoothed)
    coarse = len(objective.force.modes)
    fine_std = estimate_fine_scale_std(
        x, used, objective.faces, all_modes, coarse, is_gripped, noise_floor, default_noise
    )
    variance = variance.reshape(x.shape) + considered.square().sum(0) + fine_std.square().unsqueeze(-1)
    if any(map(len, used.clouds)):
        unknown = max(SLOW_DEPTH_ERROR_STD_M, SLOW_DEPTH_ERROR_RATIO * _point_noise(objective, used, smoothed))
        slow_std = unknown if stated is None else min(stated, SLOW_DEPTH_ERROR_STD_M)
        faces = objective.faces.numpy()
        normals = torch.as_tensor(np.stack([vertex_normals(frame, faces) for frame in x.numpy()]))
        variance = variance + slow_std**2 * normals.square()
    return variance.sqrt()


def _considered_slopes(
    wider: Objective, raw: Tensor, is_considered: Tensor, smoothed: SmoothedPose, slopes: Tensor
) -> Tensor:
    """[N, T, V, 3] m, errors of the estimate for an error of one standard deviation of each grip's place.

    A grip that is elsewhere moves the cloth, and the fitted unknowns by what they make up for.

    Args:
        wider: objective with the grips' offsets, whose tangents are remembered.
        raw: [K] the solution, with offsets of zero.
        is_considered: [K] which unknowns are offsets.
        smoothed: the solution.
        slopes: [K, T, V, 3] of the vertices.
    """
    jacobian, stds = wider.linearise(raw).jacobian, wider.prior_std[is_considered]
    weight = smoothed.final.row_weights()[0][:, None]
    gradient = (weight * jacobian[:, ~is_considered]).mT @ (jacobian[:, is_considered] * stds)
    response = (smoothed.covariance @ gradient).to(slopes)
    direct = slopes[is_considered] * stds.to(slopes)[:, None, None, None]
    return direct - torch.einsum("ktvc,kn->ntvc", slopes[~is_considered], response)


def find_gripped_vertices(cloth: Cloth, episode: Episode) -> Tensor:
    """Return whether a closed gripper holds each vertex at each observed frame, [T, V] bool."""
    times = episode.times[: episode.observed_count] + TIME_AFTER_KNOT_S
    is_gripped = torch.zeros(episode.observed_count, len(cloth.mesh.vertices), dtype=torch.bool)
    for name, part in cloth.boundaries.items():
        if isinstance(part, Grasp):
            motion = episode.motion[name]
            is_closed = motion.closed[find_last_knot(motion.t, times).clamp(min=0)]
            is_gripped[:, part.index] |= is_closed[:, None]
    return is_gripped


def _rms_over_time(objective: CorrectedObjective, force_fractions: Tensor) -> float:
    """Root mean square of fractions [W], weighted by the windows' durations."""
    times = objective.episodes[0].times
    durations = torch.stack([times[last] - times[first] for first, last in objective.force.windows])
    durations = durations.to(force_fractions)
    return float(((force_fractions.square() * durations).sum() / durations.sum()).sqrt())


def _force_fractions(objective: CorrectedObjective, raw: Tensor, is_always_gripped: Tensor, gravity: float) -> Tensor:
    """[W] force over weight, rms by mass over the cloth that is not gripped [V] all the time."""
    squared = objective.force.acceleration_field(raw[objective.force_slice]).square().sum(-1)
    mass = objective.cloth.build_model().mass.detach().squeeze(-1).to(squared) * ~is_always_gripped
    return ((squared * mass).sum(-1) / mass.sum()).sqrt() / gravity
