"""Swings and carries of the IRI rig with the times of single frames as unknowns.

Times of frames and the camera's pose come from the upper edge alone (`frame_times`), in fitted and in predicted runs.
Three numbers of the air are fitted to 20 swings by Gauss-Newton with a robust loss on the distances normal to the
cloth. Each of the camera's nodes has a constant offset, which is fitted along: the cloth appears to lean at rest.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchcloth._utils.constants import STANDARD_AIR_DENSITY_KG_PER_M3, Z_95

from ...validation.realdata import carries, frame_times, free_swing
from ...validation.realdata import swings as swing_adapter
from ...validation.realdata.frame_times import TimedRun
from . import rig
from .rig import Values
from .swings import NOMINAL_DENSITY_KG_PER_M2

DISTANCE_SCALE_M = 0.006  # larger residuals are down-weighted
RELATIVE_STEP = 0.02  # of a value, for its derivative
FIT_ROUNDS, FAST_ROUNDS = 3, 1
MAX_LOG_STEP = 0.7
TIMED_STARTS: dict[str, Values] = {
    "no memory": {"air.normal": 1.0, "added.length": 0.12, "damping.rate": 2.0},
    "entrained": {"air.normal": 1.2, "entrained.length": 0.25, "entrained.time": 0.25},
}
TIMED_UNITS = {
    "drag per areal density": "1/m",
    "added mass per areal density": "-",
    "damping rate": "1/s",
    "entrained mass per areal density": "-",
    "time in which the air follows": "s",
}
_RATIO_NAMES: dict[str, str] = dict(
    zip(("air.normal", "added.length", "damping.rate", "entrained.length", "entrained.time"), TIMED_UNITS, strict=True)
)


def read_swings(source: Path, names: Sequence[str], align: bool = True) -> list[TimedRun]:
    """Read swings with the times of their frames."""
    runs = swing_adapter.read_runs(source)
    return [frame_times.time_frames(name, runs[name], align) for name in names]


def read_carries(source: Path, names: Sequence[str] | None = None, align: bool = True) -> list[TimedRun]:
    """Read carries with the times of their frames; all of them by default."""
    runs = carries.read_runs(source)
    return [frame_times.time_frames(name, runs[name], align) for name in names or runs]


def fit(runs: Sequence[TimedRun], start: Values, rounds: int = FIT_ROUNDS) -> dict[str, Any]:
    """Fit positive values to runs.

    Standard errors are of the sandwich kind with runs as clusters: nodes and frames of one run are not independent.

    Returns:
        "values", "ratios" (by their names, to the areal density), "offsets" [A, D] m of the nodes, and "history", the
        RMS distance [m] before each round and after the last.
    """
    names, u = list(start), np.log(list(start.values()))
    step, history = np.zeros(len(u)), []
    for _ in range(rounds + 1):
        u = u - np.clip(step, -MAX_LOG_STEP, MAX_LOG_STEP)
        residual, jacobian, offsets = _linearise(runs, names, u)
        r, slopes = np.concatenate(residual), np.concatenate(jacobian)
        weight = _weight(r)
        normal = slopes.T @ (weight[:, None] * slopes)
        step = np.linalg.solve(normal, slopes.T @ (weight * r))
        history.append(float(np.sqrt((r**2).mean())))
    scores = np.stack([j.T @ (_weight(part) * part) for part, j in zip(residual, jacobian, strict=True)])
    inverse = np.linalg.inv(normal)
    std = np.sqrt((inverse @ scores.T @ scores @ inverse).diagonal()) * np.exp(u)
    values = dict(zip(names, np.exp(u).tolist(), strict=True))
    return {
        "values": values,
        "ratios": {_RATIO_NAMES[name]: _ratio(name, values[name], s) for name, s in zip(names, std, strict=True)},
        "offsets": offsets.tolist(),
        "history": history,
    }


def _linearise(
    runs: Sequence[TimedRun], names: Sequence[str], u: np.ndarray
) -> tuple[list[np.ndarray], list[np.ndarray], np.ndarray]:
    """Return residuals [N_r] m and slopes [N_r, K] m of each run by logarithms of the values, and the offsets."""
    steps = [np.zeros(len(u)), *(RELATIVE_STEP * np.eye(len(u)))]
    sets = [dict(zip(names, np.exp(u + step).tolist(), strict=True)) for step in steps]
    results = [distances(runs, motions) for motions in rig.simulate(runs, sets)]
    offsets = [node_offsets(result) for result in results]
    residuals, slopes = [], []
    for run in runs:
        here, *others = [(r[run.name] - o).ravel() for r, o in zip(results, offsets, strict=True)]
        use = np.isfinite(here)
        residuals.append(here[use])
        slopes.append(np.stack([(other[use] - here[use]) / RELATIVE_STEP for other in others], axis=-1))
    return residuals, slopes, offsets[0]


def _weight(residual: np.ndarray) -> np.ndarray:
    return (1 + (residual / DISTANCE_SCALE_M) ** 2) ** -0.5


def _ratio(name: str, value: float, std: float) -> dict[str, float]:
    """Return the identifiable quantity: a ratio to the areal density, or the value itself."""
    is_mass = name in ("air.normal", "added.length", "entrained.length")
    factor = STANDARD_AIR_DENSITY_KG_PER_M3 / NOMINAL_DENSITY_KG_PER_M2 if is_mass else 1.0
    v, s = factor * value, factor * float(std)
    return {"value": v, "std": s, "low": v - Z_95 * s, "high": v + Z_95 * s}


def distances(runs: Sequence[TimedRun], motions: Mapping[str, rig.Motion]) -> dict[str, np.ndarray]:
    """Return the normal distances [F, A, D] m of each run's nodes, by name."""
    return {run.name: rig.normal_distances(motions[run.name].at(run.t), run.nodes) for run in runs}


def node_offsets(results: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the median distance [A, D] m of each node over all frames of all runs."""
    return np.nanmedian(np.concatenate(list(results.values())), axis=0)


def still_offsets(run: TimedRun, distance: np.ndarray) -> np.ndarray:
    """Return the median distance [A, D] m of each node before the tool moves."""
    return np.nanmedian(distance[run.is_still], axis=0)


def score(runs: Sequence[TimedRun], results: Mapping[str, np.ndarray], offsets: np.ndarray | str) -> dict[str, Any]:
    """Return RMS distances [m] over all runs, in their free swings, and of each run: all nodes, and the lower edge.

    Args:
        runs: of the results.
        results: distances [F, A, D] m by the run's name.
        offsets: of the nodes, [A, D] m; "still": those of each run before the tool moves; "none".
    """

    def shift(run: TimedRun) -> np.ndarray | float:
        if isinstance(offsets, str):
            return still_offsets(run, results[run.name]) if offsets == "still" else 0.0
        return offsets

    shifted = {run.name: results[run.name] - shift(run) for run in runs}
    pooled = np.concatenate(list(shifted.values()))
    free = np.concatenate([shifted[run.name][run.t > run.stop] for run in runs])
    parts = {"free": _rms(free)} if len(free) else {}
    return {**_rms(pooled), **parts, "runs": {name: _rms(d) for name, d in shifted.items()}}


def _rms(d: np.ndarray) -> dict[str, float]:
    lower = d[:, :, 0]
    return {
        "all": float(np.sqrt(np.nanmean(d**2))),
        "lower": float(np.sqrt(np.nanmean(lower**2))),
        "median": float(np.nanmedian(np.abs(d))),
    }


def retime(
    runs: Sequence[TimedRun], motions: Mapping[str, rig.Motion], offsets: np.ndarray, reach: int = 6
) -> list[TimedRun]:
    """Return the runs with times from all nodes, with the times from the upper edge as a prior.

    This uses the free cloth, so it is no prediction. It bounds what errors of the times leave in one.

    Args:
        runs: with times from the upper edge.
        motions: by name.
        offsets: of the nodes, [A, D] m.
        reach: number of steps of 10 ms to both sides that are tried.
    """
    out = []
    for run in runs:
        best, times = np.full(len(run.t), np.inf), run.t.copy()
        for step in range(-reach, reach + 1):
            t = run.t + step * rig.OUTPUT_STEP_S
            d = (rig.normal_distances(motions[run.name].at(t), run.nodes) - offsets) / DISTANCE_SCALE_M
            independent = d.shape[1]  # nodes of one column err together
            cost = np.nansum(np.minimum(d**2, frame_times.MAX_SQUARED_EDGE_RESIDUAL), axis=(1, 2)) / independent
            cost = cost + ((t - run.t) / run.std) ** 2
            times, best = np.where(cost < best, t, times), np.minimum(cost, best)
        out.append(run._replace(t=times))
    return out


def predict_swings(source: Path, names: Sequence[str], fits: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    """Predict held-out swings with each fit; measure what each part of the residual is."""
    runs, plain = read_swings(source, names), read_swings(source, names, align=False)
    models, parts, series, free = {}, {}, {}, {"measured": free_swing_numbers(runs)}
    for label, result in fits.items():
        offsets = np.array(result["offsets"])
        [motions] = rig.simulate(runs, [result["values"]])
        measured = distances(runs, motions)
        models[label] = {kind: score(runs, measured, o) for kind, o in _offset_kinds(offsets).items()}
        series[label] = lower_edge_series(motions[runs[-1].name])
        free[label] = free_swing_numbers(runs, motions)
        [plain_motions] = rig.simulate(plain, [result["values"]])
        with_lag, again = [run.with_one_lag() for run in plain], retime(runs, motions, offsets)
        parts[label] = {
            "one lag for a run": score(with_lag, distances(with_lag, plain_motions), "none"),
            "times of frames from the upper edge": score(plain, distances(plain, plain_motions), "none"),
            "pose of the camera from the upper edge": models[label]["none"],
            "offsets of the nodes from the fitted runs": models[label]["fitted"],
            "times of frames from all nodes": score(again, distances(again, motions), offsets),
        }
    rigid = distances(runs, {run.name: rig.carry_rigidly(run) for run in runs})
    models["null"] = {kind: score(runs, rigid, kind) for kind in ("still", "none")}
    standing = np.concatenate(
        [(d - still_offsets(r, d))[r.is_still] for r, d in zip(runs, measured.values(), strict=True)]
    )
    return {
        "models": models,
        "parts": parts,
        "free_swings": free,
        "standing": _rms(standing),
        "frames": _count(runs),
        "clock": _clock(runs),
        "picture": {"run": runs[-1].name, "measured": measured_series(runs[-1]), **series},
    }


def predict_carries(
    source: Path, fits: Mapping[str, dict[str, Any]], names: Sequence[str] | None = None
) -> dict[str, Any]:
    """Predict carries whole, with what was fitted to swings."""
    runs = read_carries(source, names)
    models, series = {}, {}
    shown = max(runs, key=lambda run: np.abs(np.gradient(run.path.position(run.path.t)[:, 1], run.path.t)).max())
    for label, result in fits.items():
        [motions] = rig.simulate(runs, [result["values"]])
        measured = distances(runs, motions)
        models[label] = {kind: score(runs, measured, kind) for kind in ("still", "none")}
        series[label] = lower_edge_series(motions[shown.name])
    rigid = distances(runs, {run.name: rig.carry_rigidly(run) for run in runs})
    models["null"] = {kind: score(runs, rigid, kind) for kind in ("still", "none")}
    standing = np.concatenate(
        [(d - still_offsets(r, d))[r.is_still] for r, d in zip(runs, measured.values(), strict=True)]
    )
    kinematics = {name: carries.measure_kinematics(run)._asdict() for name, run in carries.read_runs(source).items()}
    return {
        "models": models,
        "standing": _rms(standing),
        "frames": _count(runs),
        "clock": _clock(runs),
        "kinematics": kinematics,
        "picture": {"run": shown.name, "measured": measured_series(shown), **series},
    }


def free_swing_numbers(runs: Sequence[TimedRun], motions: Mapping[str, rig.Motion] | None = None) -> dict[str, float]:
    """Return frequency [Hz] and decay [1/(m s)] of the free swings, of the nodes or of simulated motions."""
    swings = []
    for run in runs:
        t = run.t[run.t > run.stop + free_swing.SETTLING_AFTER_STOP_S]
        if motions is None:
            rows = np.nanmedian(run.nodes[run.t > run.stop + free_swing.SETTLING_AFTER_STOP_S, ..., 1], axis=1)
        else:
            x = motions[run.name].at(t).reshape(len(t), rig.RIG_COLUMNS, rig.RIG_ROWS, 3)
            rows = x[..., 1].mean(1)
        q = free_swing.project_on_mode(rows - rows[:, -1:])
        swings.append(free_swing.FreeSwing(run.name, t - run.stop, q, 0.0, 0.0))
    result = free_swing.fit_decay(swings)
    return {"frequency": result.frequency, "decay": result.decay}


def _offset_kinds(fitted: np.ndarray) -> dict[str, np.ndarray | str]:
    return {"fitted": fitted, "still": "still", "none": "none"}


def _count(runs: Sequence[TimedRun]) -> dict[str, int]:
    counts = {"all": sum(run.frames for run in runs), "used": sum(len(run.t) for run in runs)}
    rejected = {key: sum(getattr(run, key) for run in runs) for key in ("rejected_by_arc", "rejected_by_edge")}
    return counts | rejected


def _clock(runs: Sequence[TimedRun]) -> dict[str, list[float]]:
    turns = [np.degrees(np.linalg.norm(run.alignment.turn)) for run in runs if run.alignment is not None]
    rows = {
        "lag": [run.clock.lag for run in runs],
        "jitter_std": [run.clock.jitter_std for run in runs],
        "camera_turn_deg": turns,
    }
    return {key: [float(np.median(r)), float(np.min(r)), float(np.max(r))] for key, r in rows.items()}


def lower_edge_series(motion: rig.Motion) -> dict[str, list[float]]:
    """Return the lower edge's displacement from the upper edge along y [m], at half the simulated frames."""
    x = motion.x.reshape(len(motion.x), rig.RIG_COLUMNS, rig.RIG_ROWS, 3)[::2]
    return {"t": motion.t[::2].tolist(), "y": (x[:, :, 0, 1] - x[:, :, -1, 1]).mean(1).tolist()}


def measured_series(run: TimedRun) -> dict[str, list[float]]:
    """Return the same of the nodes, less what it is before the tool moves."""
    y = np.nanmedian(run.nodes[:, 1:-1, 0, 1], axis=1) - np.nanmedian(run.nodes[:, 1:-1, -1, 1], axis=1)
    return {"t": run.t.tolist(), "y": (y - np.nanmedian(y[run.is_still])).tolist()}
