"""IRI swings: predictions of 10 held-out runs, compared with the null, vacuum and textbook air.

Three things are used of a predicted run: the path of the tool, the lag of the upper edge behind the tool, and the
offset of the nodes before the tool moves, which is subtracted from all models.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchcloth.cloth import Cloth
from torchcloth.diagnosis import World
from torchcloth.episodes.replay import Replay
from torchcloth.episodes.streams import locate_on_pattern
from torchcloth.identification import build_episode, carry_rigidly
from torchcloth.losses import ClosestPoints
from torchcloth.recordings import Recording

from ...validation.realdata import free_swing, swings
from .swings import START_VALUES, cloth_of, recording

Run = dict[str, np.ndarray]
Values = dict[str, float]  # of air and damping, as ``cloth_of`` has them


def predict(source: Path, name: str, models: Mapping[str, Values | World]) -> dict[str, Any]:
    """Predict a run with each model; return squared distances of the nodes and the free swing as the camera sees it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # rows of a frame that the camera did not see at all
        return _predict(source, name, models)


def _predict(source: Path, name: str, models: Mapping[str, Values | World]) -> dict[str, Any]:
    run, data = recording(source, name), swings.read_runs(source)[name]
    t = run.require("points", by="the study").t
    rows = np.flatnonzero(np.isin(data["t_mesh_s"], t))
    measured_nodes = data["mesh_base_m"].reshape(len(data["t_mesh_s"]), -1, 3)[rows]
    moving = t - swings.estimate_lag(data).value > swings.motion_start(data)
    out: dict[str, Any] = {"t": t.tolist(), "measured": _swing(free_swing.extract_swing(name, data))}
    for model, values in {"null": None, **models}.items():
        nodes = _nodes(run, values)
        deviation = measured_nodes - nodes
        deviation = deviation - np.nanmedian(deviation[~moving], axis=0)
        out[model] = _distances(deviation[moving])
        if values is not None:
            out[model] |= _swing(free_swing.extract_swing(name, _as_seen(data, rows, nodes)))
            out[model]["lower_edge"] = _lower_edge(nodes)
        out["still"] = _distances(deviation[~moving])
    shift = np.nanmedian((measured_nodes - nodes)[~moving], axis=0)
    return out | {"lower_edge": _lower_edge(measured_nodes - shift)}


def _distances(deviation: np.ndarray) -> dict[str, float]:
    """Return statistics of the deviations of nodes [F, 64, 3] m."""
    length = np.linalg.norm(deviation, axis=-1)
    known = length[np.isfinite(length)]
    return {"squares": float((known**2).sum()), "count": len(known), "median": float(np.median(known))}


def _lower_edge(nodes: np.ndarray) -> list[float | None]:
    """Return the lower edge [F] m along the stroke; None if it was not seen."""
    y = np.nanmedian(nodes.reshape(-1, 8, 8, 3)[:, :, 0, 1], axis=1)
    return [float(one) if np.isfinite(one) else None for one in y]


def _nodes(run: Recording, model: Values | World | None) -> np.ndarray:
    """Return the nodes [F, 64, 3] m of a model at the run's frames; model None: rigid carry."""
    if isinstance(model, World):
        return _hits(model.cloth).interpolate(model.simulate_observed(build_episode(model.cloth, run)).x).numpy()
    cloth = cloth_of(run, model or START_VALUES)
    data = build_episode(cloth, run)
    with torch.no_grad():
        x = carry_rigidly(data) if model is None else Replay(cloth)(data).x
    return _hits(cloth).interpolate(x).numpy()


def _hits(cloth: Cloth) -> ClosestPoints:
    """Return the places of the camera's 8 x 8 nodes on the sheet."""
    u = np.linspace(0, swings.SHEET_SIDE_M, 8)
    return locate_on_pattern(cloth.mesh, np.stack(np.meshgrid(u, u, indexing="ij"), -1).reshape(-1, 2))


def _as_seen(data: Run, rows: np.ndarray, nodes: np.ndarray) -> Run:
    """Return the run with a model's nodes in the used frames and NaN in the others."""
    mesh = np.full_like(data["mesh_base_m"], np.nan)
    mesh[rows] = nodes.reshape(-1, 8, 8, 3)
    return {**data, "mesh_base_m": mesh}


def _swing(swing: Any) -> dict[str, list[float]]:
    return {"swing_t": swing.t.tolist(), "swing_q": swing.q.tolist()}


def summary(runs: dict[str, dict[str, Any]], models: Sequence[str], draws: int = 20) -> dict[str, Any]:
    """Return node RMS, frequency and decay of each model over the predicted runs, with bootstrap standard errors."""
    chosen = bootstrap_indices(len(runs), draws)
    out: dict[str, Any] = {}
    for model in ("still", "null", *models):
        rows = [run[model] for run in runs.values()]
        rms = [np.sqrt(sum(rows[i]["squares"] for i in d) / sum(rows[i]["count"] for i in d)) for d in chosen]
        median = float(np.mean([row["median"] for row in rows]))
        out[model] = {"rms": float(rms[0]), "rms_std": float(np.std(rms[1:])), "median": median}
    for model in ("measured", *models):
        out.setdefault(model, {}).update(frequency_and_decay([run[model] for run in runs.values()], chosen))
    return out


def bootstrap_indices(count: int, draws: int) -> list[np.ndarray]:
    """Return all indices once, then bootstrap samples of them."""
    draw = np.random.default_rng(0)
    return [np.arange(count), *(draw.integers(0, count, count) for _ in range(draws))]


def frequency_and_decay(rows: Sequence[dict[str, Any]], chosen: Sequence[np.ndarray]) -> dict[str, float]:
    """Return frequency and decay of all runs, and their standard deviations over the bootstrap samples."""
    swings = [free_swing.FreeSwing("", np.array(row["swing_t"]), np.array(row["swing_q"]), 0.0, 0.0) for row in rows]
    fits = np.array([free_swing.fit_decay([swings[i] for i in d])[:2] for d in chosen])
    std = fits[1:].std(0)
    value = dict(zip(("frequency", "decay"), fits[0].tolist(), strict=True))
    return value | {"frequency_std": float(std[0]), "decay_std": float(std[1])}
