"""A simulated cloth beside measured points, coloured by how far they are from it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ..diagnosis import read_model, start_of
from ..diagnosis.models.loading import watched
from ..episodes.observed import DEFAULT_FRAME_RATE_HZ, build_episode
from ..episodes.streams import SAME_TIME_S
from ..identification import replayed
from ..losses import closest
from ..recordings import Recording
from .film import DISTANCE, Curve, Film, Sheet
from .geometry import Array, edges_of
from .recording_film import film_of

MODEL = ".tcm"
QUANTILE = 0.95  # of the distances, is dark red
NOISES = 4.0  # standard deviations of the sensor that the colour bar spans at least
LEAST = 2.0  # mm, that the colour bar spans at least
THIN = 0.2  # share of the mean density of points below which a vertex counts as unseen
MOST_STEPS = 30


def film_of_fit(recording: Recording, fit: str | Path, *, truth: bool = False) -> Film:
    """An episode and the cloth simulated with fitted values, coloured by distance.

    Args:
        recording: one of the fit's episodes, or another of the same cloth, which is then predicted.
        fit: identification.json, or the folder that holds it; or a .tcm file of ``diagnose``.
        truth: as of ``film_of``.

    Raises:
        InvalidInput: the fit is of another model.
        RecordingError: the file cannot be read.
    """
    if Path(fit).suffix == MODEL:
        return _film_of_model(recording, fit, truth)
    again = replayed(fit, recording, start_of(fit))
    film = film_of(recording, truth=truth, times=again.episode.times.numpy())
    film = _beside(film, recording, again.frames.numpy(), again.cloth.mesh.faces)
    distance = f", {1e3 * float(again.chamfer.mean()):.2f} mm from the points" if len(again.chamfer) else ""
    title = f"{film.title}: {'fitted' if again.fitted else 'predicted'}{distance}"
    return replace(film, title=title, notes=film.notes + ((again.warning,) if again.warning else ()))


def _film_of_model(recording: Recording, path: str | Path, truth: bool) -> Film:
    """As ``film_of_fit``, with the cloth, robot and observer of a model file."""
    model = read_model(path, recording).model
    world, data = model.world(), build_episode(model.base.cloth, recording, DEFAULT_FRAME_RATE_HZ)
    film = film_of(recording, truth=truth, times=data.times.numpy())
    x = watched(world, data).x.numpy()
    film = _beside(film, recording, x, world.cloth.mesh.faces)
    far = film.curves[DISTANCE].values if DISTANCE in film.curves else np.array([np.nan])
    distance = f", {np.nanmean(far):.2f} mm from the points" if np.isfinite(far).any() else ""
    return replace(film, title=f"{film.title}: {Path(path).stem} model{distance}")


def _beside(film: Film, recording: Recording, vertices: Array, faces: Array) -> Film:
    """With the cloth, at the times of points where there are any: of others there is no distance."""
    told = _when(recording, film.times)
    if told.any():
        kept = np.flatnonzero(told)
        film, vertices, told = film.take(kept), vertices[kept], told[kept]
    return with_cloth(film, vertices, faces, noise=recording.observation_noise_std, told=told)


def _when(recording: Recording, times: Array) -> Array:
    """[T] whether points were seen then, and not only a little before or after."""
    if recording.points is None:
        return np.zeros(len(times), dtype=bool)
    return np.abs(times[:, None] - recording.points.t - recording.clock_offset).min(1) <= SAME_TIME_S


def with_cloth(
    film: Film, vertices: Array, faces: Array, *, noise: float | None = None, told: Array | None = None
) -> Film:
    """The film with a simulated cloth, coloured by the distance of the film's points where there are some near.

    The distance of each point from the surface is spread over the fabric around the place that is nearest to it, as
    far as points lie apart. The curve "distance" is the mean over the points of each frame. Other cloths of the film
    become nets, so that this one can be seen.

    Args:
        film: shows the measured points as the cloud "points"; without it the cloth has a plain colour.
        vertices: [T, V, 3] m at the film's times.
        faces: [F, 3].
        noise: of one point, standard deviation [m]: the colour bar does not dramatise it.
        told: [T] whether the points of a frame are of its time; None: all are. Others are shown and not measured.
    """
    sheets = {name: replace(sheet, net=True) for name, sheet in film.sheets.items()}
    if "points" not in film.clouds:
        return replace(film, sheets={**sheets, "cloth": Sheet(vertices.astype(np.float32), faces)})
    values, means = [], []
    told = np.ones(len(vertices), dtype=bool) if told is None else told
    for x, cloud, counts in zip(vertices, film.clouds["points"].frames, told, strict=True):
        distance, mean = _distances(cloud if counts else cloud[:0], x, faces)
        values.append(1e3 * distance)
        means.append(1e3 * mean)
    cloth = Sheet(vertices.astype(np.float32), faces, np.stack(values).astype(np.float32))
    curve = {DISTANCE: Curve(film.times, np.array(means), "mm")} if np.isfinite(means).any() else {}
    return replace(
        film,
        sheets={**sheets, "cloth": cloth},
        curves={**curve, **film.curves},
        worst=_worst(np.stack(values), noise),
        legend="distance of measured points",
        grey="none near",
    )


def _distances(points: Array, x: Array, faces: Array) -> tuple[Array, float]:
    """(distance [V] m spread over the vertices, NaN where no point is near; mean [m] over the points)."""
    if len(points) == 0:
        return np.full(len(x), np.nan), float("nan")
    cloud, vertices = torch.as_tensor(points, dtype=torch.float64), torch.as_tensor(x, dtype=torch.float64)
    hits = closest(cloud, vertices, torch.as_tensor(faces))
    distance = (cloud - hits.on(vertices)).norm(dim=-1).numpy()
    corners, weights = hits.corners.numpy(), hits.weights.numpy()
    seen = np.stack([weights, weights * distance[:, None]], axis=-1)  # [N, 3, 2]
    share = np.zeros((len(x), 2))
    np.add.at(share, corners, seen)
    share = _spread(share, x, faces, len(points))
    known = share[:, 0] > THIN * len(points) / len(x)
    return np.where(known, share[:, 1] / np.where(known, share[:, 0], 1), np.nan), float(distance.mean())


def _spread(share: Array, x: Array, faces: Array, points: int) -> Array:
    """[V, C] after so many steps of a random walk along the edges that it gets as far as points lie apart."""
    edges = edges_of(faces)
    length = np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=-1).mean()
    a, b, c = x[faces[:, 0]], x[faces[:, 1]], x[faces[:, 2]]
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1).sum()
    steps = int(np.clip(np.ceil(2.3 * area / points / length**2), 1, MOST_STEPS))  # 6/7 of length^2 / 2 an axis a step
    stay = 1 / (1 + np.bincount(edges.ravel(), minlength=len(x)))[:, None]
    for _ in range(steps):
        out = share * stay
        share = out.copy()
        np.add.at(share, edges[:, 0], out[edges[:, 1]])
        np.add.at(share, edges[:, 1], out[edges[:, 0]])
    return share


def _worst(values: Array, noise: float | None) -> float:
    """A round number of mm for the end of the colour bar."""
    seen = values[np.isfinite(values)]
    least = max(LEAST, 1e3 * NOISES * (noise or 0.0), float(np.quantile(seen, QUANTILE)) if len(seen) else 0.0)
    decade = 10.0 ** np.floor(np.log10(least))
    return float(decade * min(step for step in (1, 1.5, 2, 3, 4, 5, 6, 8, 10) if step * decade >= least * (1 - 1e-9)))
