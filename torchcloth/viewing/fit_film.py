"""Films of a simulated cloth and measured points, coloured by the distance of the points."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ..diagnosis import make_start_builder, read_model
from ..diagnosis.models.loading import simulate_frames
from ..episodes.observed import DEFAULT_FRAME_RATE_HZ, build_episode
from ..episodes.streams import SAME_TIME_S
from ..errors import InvalidInput
from ..identification import replay_fit
from ..losses import find_closest_points
from ..recordings import Recording
from .colours import COLOUR_LIMIT_QUANTILE, MIN_COLOUR_LIMIT_MM
from .film import DISTANCE_CURVE, ClothSurface, Curve, Film
from .geometry import Array, unique_edges
from .recording_film import film_from_recording

MODEL_SUFFIX = ".tcm"
MIN_COLOUR_LIMIT_STDS = 4.0  # standard deviations of the sensor that the colour bar spans at least
MIN_POINT_DENSITY_RATIO = 0.2  # of the mean density of points; a vertex with fewer points counts as unobserved
MAX_SPREAD_STEPS = 30


def film_from_fit(recording: Recording, fit: str | Path, *, truth: bool = False, at_start: bool = False) -> Film:
    """Make a film of an episode and of the cloth simulated with fitted values, coloured by distance.

    Args:
        recording: an episode of the fit, or another episode of the same cloth, which is then predicted.
        fit: identification.json, the folder that contains it, or a .tcm file of ``diagnose``.
        truth: see ``film_from_recording``.
        at_start: simulate with the values that the search started from instead of the fitted ones.

    Raises:
        InvalidInput: the fit belongs to another model, or the start of a .tcm file is asked for.
        RecordingError: the file cannot be read.
    """
    if Path(fit).suffix == MODEL_SUFFIX:
        if at_start:
            raise InvalidInput("start values", got=str(fit), expected="identification.json, which holds them")
        return _film_from_model(recording, fit, truth)
    replay = replay_fit(fit, recording, make_start_builder(fit), at_start=at_start)
    film = film_from_recording(recording, truth=truth, times=replay.episode.times.numpy())
    film = _add_cloth_at_point_times(film, recording, replay.frames.numpy(), replay.cloth.mesh.faces)
    distance = f", {1e3 * float(replay.chamfer.mean()):.2f} mm from the points" if len(replay.chamfer) else ""
    state = "start values" if at_start else "fitted" if replay.was_fitted else "predicted"
    title = f"{film.title}: {state}{distance}"
    return replace(film, title=title, notes=film.notes + ((replay.warning,) if replay.warning else ()))


def _film_from_model(recording: Recording, path: str | Path, truth: bool) -> Film:
    """Make the film with the cloth, robot and observer of a model file."""
    model = read_model(path, recording).model
    world, data = model.build_world(), build_episode(model.base.cloth, recording, DEFAULT_FRAME_RATE_HZ)
    film = film_from_recording(recording, truth=truth, times=data.times.numpy())
    x = simulate_frames(world, data).x.numpy()
    film = _add_cloth_at_point_times(film, recording, x, world.cloth.mesh.faces)
    distances = film.curves[DISTANCE_CURVE].values if DISTANCE_CURVE in film.curves else np.array([np.nan])
    distance = f", {np.nanmean(distances):.2f} mm from the points" if np.isfinite(distances).any() else ""
    return replace(film, title=f"{film.title}: {Path(path).stem} model{distance}")


def _add_cloth_at_point_times(film: Film, recording: Recording, vertices: Array, faces: Array) -> Film:
    """Add the cloth; if points were observed, keep only the frames at their times, as others have no distance."""
    is_observed = _is_observed(recording, film.times)
    if is_observed.any():
        frames = np.flatnonzero(is_observed)
        film, vertices, is_observed = film.select_frames(frames), vertices[frames], is_observed[frames]
    return add_cloth(film, vertices, faces, noise=recording.observation_noise_std, is_observed=is_observed)


def _is_observed(recording: Recording, times: Array) -> Array:
    """Return [T] bool: whether points were observed at each time, and not only shortly before or after."""
    if recording.points is None:
        return np.zeros(len(times), dtype=bool)
    return np.abs(times[:, None] - recording.points.t - recording.clock_offset).min(1) <= SAME_TIME_S


def add_cloth(
    film: Film, vertices: Array, faces: Array, *, noise: float | None = None, is_observed: Array | None = None
) -> Film:
    """Add a simulated cloth to a film, coloured by the distance of nearby points.

    The distance of each point is spread over the fabric around its nearest surface point, as far as points lie apart.
    The curve "distance" is the mean over the points of each frame. Other cloths of the film become outlines, so that
    they do not hide this one.

    Args:
        film: contains the measured points as the cloud "points"; without it the cloth has a plain colour.
        vertices: [T, V, 3] m at the film's times.
        faces: [F, 3].
        noise: standard deviation of one point [m]; the colour bar spans several of them.
        is_observed: [T] bool, whether the points of a frame were observed at its time; None: all were. Other points
            are shown, but their distance is not measured.
    """
    sheets = {name: replace(sheet, outline=True) for name, sheet in film.sheets.items()}
    if "points" not in film.clouds:
        return replace(film, sheets={**sheets, "cloth": ClothSurface(vertices.astype(np.float32), faces)})
    values, means = [], []
    is_observed = np.ones(len(vertices), dtype=bool) if is_observed is None else is_observed
    for x, cloud, counts in zip(vertices, film.clouds["points"].frames, is_observed, strict=True):
        distance, mean = _vertex_distances(cloud if counts else cloud[:0], x, faces)
        values.append(1e3 * distance)
        means.append(1e3 * mean)
    cloth = ClothSurface(vertices.astype(np.float32), faces, np.stack(values).astype(np.float32))
    curve = {DISTANCE_CURVE: Curve(film.times, np.array(means), "mm")} if np.isfinite(means).any() else {}
    return replace(
        film,
        sheets={**sheets, "cloth": cloth},
        curves={**curve, **film.curves},
        colour_limit=_choose_colour_limit(np.stack(values), noise),
        legend="distance of measured points",
        grey_label="none near",
    )


def _vertex_distances(points: Array, x: Array, faces: Array) -> tuple[Array, float]:
    """Return distances [V] m, spread over the vertices, NaN without points nearby; and the mean [m] over the points."""
    if len(points) == 0:
        return np.full(len(x), np.nan), float("nan")
    cloud, vertices = torch.as_tensor(points, dtype=torch.float64), torch.as_tensor(x, dtype=torch.float64)
    hits = find_closest_points(cloud, vertices, torch.as_tensor(faces))
    distance = (cloud - hits.interpolate(vertices)).norm(dim=-1).numpy()
    corners, weights = hits.corners.numpy(), hits.weights.numpy()
    seen = np.stack([weights, weights * distance[:, None]], axis=-1)  # [N, 3, 2]
    values_and_weights = np.zeros((len(x), 2))
    np.add.at(values_and_weights, corners, seen)
    values_and_weights = _spread_along_edges(values_and_weights, x, faces, len(points))
    known = values_and_weights[:, 0] > MIN_POINT_DENSITY_RATIO * len(points) / len(x)
    per_vertex = np.where(known, values_and_weights[:, 1] / np.where(known, values_and_weights[:, 0], 1), np.nan)
    return per_vertex, float(distance.mean())


def _spread_along_edges(values_and_weights: Array, x: Array, faces: Array, points: int) -> Array:
    """Smooth [V, C] by a random walk along the edges, as far as points lie apart."""
    edges = unique_edges(faces)
    length = np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=-1).mean()
    a, b, c = x[faces[:, 0]], x[faces[:, 1]], x[faces[:, 2]]
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1).sum()
    steps = int(
        np.clip(np.ceil(2.3 * area / points / length**2), 1, MAX_SPREAD_STEPS)
    )  # 6/7 of length^2 / 2 an axis a step
    stay = 1 / (1 + np.bincount(edges.ravel(), minlength=len(x)))[:, None]
    for _ in range(steps):
        out = values_and_weights * stay
        values_and_weights = out.copy()
        np.add.at(values_and_weights, edges[:, 0], out[edges[:, 1]])
        np.add.at(values_and_weights, edges[:, 1], out[edges[:, 0]])
    return values_and_weights


def _choose_colour_limit(values: Array, noise: float | None) -> float:
    """Return a round number of mm for the end of the colour bar."""
    seen = values[np.isfinite(values)]
    lower_limit = max(
        MIN_COLOUR_LIMIT_MM,
        1e3 * MIN_COLOUR_LIMIT_STDS * (noise or 0.0),
        float(np.quantile(seen, COLOUR_LIMIT_QUANTILE)) if len(seen) else 0.0,
    )
    decade = 10.0 ** np.floor(np.log10(lower_limit))
    return float(
        decade * min(step for step in (1, 1.5, 2, 3, 4, 5, 6, 8, 10) if step * decade >= lower_limit * (1 - 1e-9))
    )
