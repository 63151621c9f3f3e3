"""Draw a fit: the cloth over the cloud, the distance over time and iterations, the parameters with intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .._utils.files import save_figure
from ..cloth import Cloth
from ..episodes.observed import Episode
from ..losses import find_closest_points
from .result import Identification

MIN_LOG_AXIS_RATIO = 5.0  # between the ends of an axis of positive values, from which it is logarithmic
SHAPE_FRAMES = 4  # that are drawn of an episode
BEFORE_COLOUR, AFTER_COLOUR, NULL_COLOUR = "#b0653a", "#1f6f8b", "#888888"


def save_fit_pictures(fit: Identification, episodes: Sequence[Episode], faces: np.ndarray, folder: Path) -> list[Path]:
    """Write fit.png, distances.png, forces.png and parameters.png into ``folder``, those that have something to show.

    Pictures of an earlier fit that now have nothing to show are removed.

    Args:
        fit: the result.
        episodes: of the fit.
        faces: [F, 3].
        folder: made if it does not exist.

    Returns:
        Their paths.
    """
    folder.mkdir(parents=True, exist_ok=True)
    figures, seen = (
        {},
        [k for k, e in enumerate(episodes) if any(len(e.observed_points(t)) for t in range(len(e.times)))],
    )
    if seen:
        figures = {
            "fit": plot_shapes(fit, seen[0], episodes[seen[0]], faces),
            "distances": plot_distances(fit, episodes, faces),
        }
    if any(_force_readings(e) for e in episodes):
        figures["forces"] = plot_forces(fit, episodes)
    figures["parameters"] = plot_parameters(fit)
    for name in {"fit", "distances", "forces"} - figures.keys():
        (folder / f"{name}.png").unlink(missing_ok=True)
    return [save_figure(figure, folder / f"{name}.png") for name, figure in figures.items()]


def _distance(cloud: Tensor, vertices: Tensor, faces: Tensor) -> np.ndarray:
    return (cloud - find_closest_points(cloud, vertices, faces).interpolate(vertices)).norm(dim=-1).numpy()


def plot_shapes(fit: Identification, k: int, episode: Episode, faces: np.ndarray) -> Any:
    """Draw four frames of the ``k``-th episode: points coloured by their distance, over the start and the fit."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    index = torch.as_tensor(faces)
    clouds = [episode.observed_points(t) for t in range(len(episode.times))]
    seen = np.flatnonzero([len(cloud) for cloud in clouds])
    shown = seen[np.linspace(0, len(seen) - 1, SHAPE_FRAMES + 1).round().astype(int)[1:]]
    figure = Figure(figsize=(15, 7.5))
    axes = figure.subplots(2, SHAPE_FRAMES, subplot_kw={"projection": "3d", "computed_zorder": False})
    figure.subplots_adjust(wspace=0.02, hspace=0.05, top=0.92, bottom=0.02, left=0.02)
    everything = torch.cat([fit.frames_after[k][shown].reshape(-1, 3), *(clouds[i] for i in shown)]).numpy()
    middle, half = (everything.max(0) + everything.min(0)) / 2, np.ptp(everything, axis=0).max() / 2
    worst = 1e3 * max(np.quantile(_distance(clouds[i], fit.frames_before[k][i], index), 0.95) for i in shown)
    for row, (label, frames) in enumerate((("start", fit.frames_before[k]), ("fitted", fit.frames_after[k]))):
        for column, i in enumerate(shown):
            axis, x, cloud = axes[row, column], frames[i].numpy(), clouds[i].numpy()
            axis.plot_trisurf(
                *x.T, triangles=faces, color="#dde5ea", edgecolor="#8fa3ad", linewidth=0.2, alpha=0.6, zorder=1
            )
            distance = 1e3 * _distance(clouds[i], frames[i], index)
            axis.scatter(*cloud.T, c=distance, s=5, cmap="inferno_r", vmin=0, vmax=worst, depthshade=False, zorder=2)
            title = f"{label}, t = {float(episode.times[i]):.2f} s: {distance.mean():.2f} mm"
            axis.set_title(title, fontsize=10, parse_math=False)
            axis.set(**{f"{a}lim": (m - half, m + half) for a, m in zip("xyz", middle, strict=True)})
            axis.set_box_aspect((1, 1, 1), zoom=1.15)
            axis.tick_params(labelsize=6)
            axis.locator_params(nbins=4)
            axis.patch.set_alpha(0)
            axis.view_init(elev=12, azim=-60)
    scale = ScalarMappable(Normalize(0, worst), "inferno_r")
    figure.colorbar(scale, ax=axes, shrink=0.6, label="distance of a measured point from the surface [mm]")
    figure.suptitle(f"{episode.name}: measured points over the simulated cloth (axes in m)", x=0.45, parse_math=False)
    return figure


def plot_distances(fit: Identification, episodes: Sequence[Episode], faces: np.ndarray) -> Any:
    """Draw the mean distance over time, and over the iterations of the fit."""
    from matplotlib.figure import Figure

    index = torch.as_tensor(faces)
    figure = Figure(figsize=(12, 4))
    over_time, over_fit = figure.subplots(1, 2)
    sources = (
        ("carried rigidly", fit.frames_null, NULL_COLOUR),
        ("start", fit.frames_before, BEFORE_COLOUR),
        ("fitted", fit.frames_after, AFTER_COLOUR),
    )
    for label, frames, colour in sources:
        for k, (x, episode) in enumerate(zip(frames, episodes, strict=True)):
            shown = [t for t in range(len(x)) if len(episode.observed_points(t))]
            mean = [1e3 * _distance(episode.observed_points(t), x[t], index).mean() for t in shown]
            over_time.plot(episode.times[shown], mean, color=colour, label=label if k == 0 else None)
    over_time.set(xlabel="time [s]", ylabel="mean distance cloud to surface [mm]", yscale="log")
    over_time.legend()
    for fraction in sorted({entry["frame_fraction"] for entry in fit.history}):
        part = [entry for entry in fit.history if entry["frame_fraction"] == fraction]
        style = {"marker": "o", "color": AFTER_COLOUR, "alpha": 1.0 if fraction == 1 else 0.4}
        label = "all frames" if fraction == 1 else f"first {100 * fraction:.0f} % of the frames"
        over_fit.plot([e["iteration"] for e in part], [1e3 * e["chamfer"] for e in part], label=label, **style)
    over_fit.axhline(1e3 * fit.fit["chamfer_null"], color=NULL_COLOUR, linestyle="--", label="carried rigidly")
    over_fit.set(xlabel="iteration", ylabel="Chamfer cloud to surface [mm]", yscale="log")
    over_fit.legend()
    figure.tight_layout()
    return figure


def plot_forces(fit: Identification, episodes: Sequence[Episode]) -> Any:
    """Draw every gripper's force along its main direction, measured and simulated, one row per episode."""
    from matplotlib.figure import Figure

    rows = [(k, e, forces) for k, e in enumerate(episodes) if (forces := _force_readings(e))]
    columns = max(len(forces) for *_, forces in rows)
    figure = Figure(figsize=(6 * columns, 3 * len(rows) + 0.4))
    axes = figure.subplots(len(rows), columns, squeeze=False)
    for row, (k, e, forces) in zip(axes, rows, strict=True):
        for axis, (name, readings) in zip(row, forces.items(), strict=False):
            force, along = _along_main_direction(readings)
            axis.plot(e.times[1:], force @ along, ".", color="black", markersize=4, label="measured")
            for label, source, colour in (
                ("start", fit.forces_before, BEFORE_COLOUR),
                ("fitted", fit.forces_after, AFTER_COLOUR),
            ):
                axis.plot(e.times[1:], source[k][name][1:, :3] @ along, color=colour, label=label)
            axis.set(xlabel="time [s]", ylabel="force [N]")
            title = f"{e.name}, {name}: along ({', '.join(f'{a:.2f}' for a in along.tolist())})"
            axis.set_title(title, fontsize=10, parse_math=False)
        for axis in row[len(forces) :]:
            axis.set_axis_off()
    axes[0, 0].legend()
    figure.tight_layout()
    return figure


def _force_readings(e: Episode) -> dict[str, Tensor]:
    """Forces [T, 3] N after the first frame, of grippers that measured any."""
    forces = {name: wrench[1:, :3] for name, wrench in e.wrenches.items()}
    return {name: force for name, force in forces.items() if bool(force.isfinite().all(-1).any())}


def _along_main_direction(force: Tensor) -> tuple[Tensor, Tensor]:
    """(readings [T, 3], unit vector [3] along which they are largest, towards most of them)."""
    measured = force[force.isfinite().all(-1)]
    along = torch.linalg.svd(measured, full_matrices=False)[2][0]
    return force, along * torch.sign((measured @ along).sum())


def plot_parameters(fit: Identification) -> Any:
    """Draw start, estimate and 95 % interval of every fitted parameter."""
    from matplotlib.figure import Figure

    shown = {n: e for n, e in fit.parameters.items() if e.source in ("data", "prior")}
    figure = Figure(figsize=(8, 1.1 * len(shown) + 0.6))
    axes = figure.subplots(len(shown), 1, squeeze=False)
    for axis, (name, e) in zip(axes[:, 0], shown.items(), strict=True):
        colour = AFTER_COLOUR if e.identifiable else NULL_COLOUR
        if not fit.is_withdrawn:
            axis.plot(e.ci95, [0, 0], color=colour, linewidth=4, alpha=0.4, solid_capstyle="butt")
            axis.plot(e.value, 0, "o", color=colour)
        axis.plot(e.initial, 0, "x", color=BEFORE_COLOUR)
        note = {"prior": " (measured)"}.get(e.source, "") if e.identifiable else "\n(not identifiable)"
        axis.set_ylabel(f"{name}{note}\n[{e.unit}]", rotation=0, ha="right", va="center", fontsize=9)
        axis.set_yticks([])
        axis.spines[["left", "top", "right"]].set_visible(False)
        ends = [e.initial] if fit.is_withdrawn else [*e.ci95, e.value, e.initial]
        if min(ends) > 0 and max(ends) > MIN_LOG_AXIS_RATIO * min(ends):
            axis.set_xscale("log")
        axis.margins(x=0.1)
    figure.suptitle("estimate and 95 % interval; cross: start", fontsize=10)
    figure.tight_layout()
    return figure


def plot_fields(fields: Mapping[str, Tensor], cloth: Cloth) -> Any:
    """Draw one value per triangle [F] on the cloth's pattern or, without one, on its rest mesh seen along z."""
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

    mesh = cloth.mesh
    place = np.asarray(mesh.vertices)[:, :2] if mesh.uv is None else np.asarray(mesh.uv)
    figure = Figure(figsize=(5.5 * len(fields), 4.5), layout="constrained")
    for axis, (name, values) in zip(figure.subplots(1, len(fields), squeeze=False)[0], fields.items(), strict=True):
        shown = values.detach().numpy()
        norm = LogNorm() if shown.max() > MIN_LOG_AXIS_RATIO * shown.min() > 0 else None
        triangles = axis.tripcolor(*place.T, np.asarray(mesh.faces), facecolors=shown, norm=norm)
        figure.colorbar(triangles, ax=axis, label=getattr(cloth.material, name).unit, shrink=0.8)
        axis.set(title=name, aspect="equal", xlabel="m", ylabel="m")
    return figure
