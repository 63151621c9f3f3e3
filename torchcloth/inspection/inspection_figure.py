"""One picture of an episode: when its streams tick, what two frames show, where the clocks agree."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..identification.pictures import save_figure
from ..observe import decode
from ..recordings.timing import GAP, times
from .inspect_recording import Inspection

INK, GOOD, BAD, SOFT = "#1f6f8b", "#1f6f8b", "#b0653a", "#888888"
MOST = 3000  # points drawn of a frame


def draw(report: Inspection, folder: str | Path) -> Path:
    """Write inspection.png into ``folder``, atomically; returns its path."""
    from matplotlib.figure import Figure

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(15, 9))
    grid = figure.add_gridspec(
        2, 3, height_ratios=[1, 1.5], hspace=0.3, wspace=0.2, top=0.9, bottom=0.07, left=0.06, right=0.98
    )
    _timeline(figure.add_subplot(grid[0, :2]), report)
    _clock(figure.add_subplot(grid[0, 2]), report)
    shown = _shown(report)
    if not shown:
        _images([figure.add_subplot(grid[1, column]) for column in (0, 1)], report)
    for column, (kind, i) in enumerate(shown):
        _frame(figure.add_subplot(grid[1, column], projection="3d"), report, kind, i)
    _quality(figure.add_subplot(grid[1, 2]), report)
    name = report.recording.path.name if report.recording.path else "recording"
    figure.suptitle(f"{name}: {report.recording.provenance}", fontsize=11, parse_math=False)
    return save_figure(figure, folder / "inspection.png")


def _timeline(axis: Any, report: Inspection) -> None:
    """A tick per frame; gaps in another colour, rejected frames too."""
    streams = times(report.recording)
    shift = _shift(report)
    for row, (name, (kind, t)) in enumerate(streams.items()):
        moved = t if kind in ("motion", "joints", "motion + joints") else t + shift
        axis.vlines(moved, row - 0.35, row + 0.35, color=GOOD, linewidth=0.6)
        between = np.diff(t)
        for k in np.flatnonzero(between > GAP * np.median(between)) if len(between) else []:
            axis.plot(moved[k : k + 2], [row, row], color=BAD, linewidth=3, solid_capstyle="butt")
        if name in report.frames:
            axis.plot(
                moved[report.frames[name].rejected],
                np.full(report.frames[name].rejected.sum(), row + 0.42),
                "v",
                color=BAD,
                markersize=4,
            )
    axis.set_yticks(range(len(streams)), list(streams), parse_math=False)
    axis.set(xlabel="time on the motion clock [s]")
    axis.set_title("streams: bars are gaps, triangles rejected frames", fontsize=10)
    axis.invert_yaxis()


def _shift(report: Inspection) -> float:
    """s, from the observations' clock to the motion's."""
    return report.recording.clock_offset if report.lag is None else -report.lag.trusted


def _clock(axis: Any, report: Inspection) -> None:
    axis.set_title("lag of the observations", fontsize=10)
    late = report.lag
    if late is None:
        return _nothing(axis, "no motion, or too few observations")
    axis.plot(late.tried, 1e3 * late.cost, color=INK)
    axis.axvline(late.stated, color=SOFT, linestyle="--", label=f"recording says {late.stated:.3f} s")
    if late.told:
        axis.axvspan(late.value - 2 * late.std, late.value + 2 * late.std, color=BAD, alpha=0.25)
        axis.axvline(late.value, color=BAD, label=f"found {late.value:.3f} ± {late.std:.3f} s")
    axis.set(xlabel="lag tried [s]", ylabel="misfit of what is held [mm]")
    axis.locator_params(axis="x", nbins=5)
    axis.legend(fontsize=8)


def _shown(report: Inspection) -> list[tuple[str, int]]:
    """Two frames that are not rejected, a third and two thirds through: of markers, or else of clouds."""
    for kind in ("markers", "points"):
        if kind in report.frames:
            good = np.flatnonzero(~report.frames[kind].rejected)
            if len(good):
                return [(kind, int(good[len(good) * k // 3])) for k in (1, 2)]
    return []


def _images(axes: list[Any], report: Inspection) -> None:
    """Two depth images of a camera, where there are no frames of points to draw."""
    seen = [
        (name, camera.depth, camera.depth_scale)
        for name, camera in report.recording.cameras.items()
        if name in report.depth and camera.depth is not None and camera.depth_scale is not None
    ]
    for share, axis in zip((1, 2), axes, strict=True):
        if not seen:
            _nothing(axis, "no good frame" if report.frames else "nothing to draw: no points, no markers, no depth")
            continue
        name, images, scale = seen[0]
        i = len(images) * share // 3
        depth = decode(images.load(i), scale)
        shown = axis.imshow(np.where(depth > 0, depth, np.nan), cmap="viridis")
        axis.figure.colorbar(shown, ax=axis, shrink=0.6, label="depth [m]")
        axis.set(xticks=[], yticks=[])
        axis.set_title(f"{name}, depth image {i}", fontsize=10, parse_math=False)


def _frame(axis: Any, report: Inspection, kind: str, i: int) -> None:
    """A frame with the grippers' whole paths and places."""
    recording = report.recording
    stream = getattr(recording, kind)
    cloud = stream.xyz[i] if kind == "markers" else stream.frame(i)
    cloud = cloud[np.isfinite(cloud[:, 0])]
    cloud = cloud[:: max(1, len(cloud) // MOST)]
    t = stream.t[i] + _shift(report)
    axis.scatter(*cloud.T, s=6 if len(cloud) < 500 else 1, color=INK, depthshade=False)
    everything = [cloud]
    for name, path in report.paths.items():
        axis.plot(*path.position.T, color=SOFT, linewidth=0.8)
        here = path.at(np.array([t]))[0]
        axis.scatter(*here.T, s=40, color=BAD, marker="s", depthshade=False)
        axis.text(*here[0], f" {name}", fontsize=7, color=BAD, parse_math=False)
        everything.append(path.position)
    points = np.concatenate(everything)
    middle, half = (points.max(0) + points.min(0)) / 2, max(np.ptp(points, axis=0).max() / 2, 1e-3)
    axis.set(**{f"{a}lim": (m - half, m + half) for a, m in zip("xyz", middle, strict=True)})
    axis.set_box_aspect((1, 1, 1), zoom=1.1)
    axis.tick_params(labelsize=6, pad=-2)
    axis.locator_params(nbins=4)
    for name in "xyz":
        getattr(axis, f"set_{name}label")(f"{name} [m]", fontsize=7, labelpad=-8)
    axis.set_title(f"{kind}, frame {i}, t = {stream.t[i]:.2f} s", fontsize=10, parse_math=False)


def _quality(axis: Any, report: Inspection) -> None:
    """Coverage of every frame."""
    axis.set_title("coverage by frame", fontsize=10)
    if not any(np.isfinite(f.coverage).any() for f in report.frames.values()):
        return _nothing(axis, "nothing observed, or the cloth's size is unknown")
    for (name, found), marker in zip(report.frames.items(), "os", strict=False):
        t = getattr(report.recording, name).t
        axis.plot(t, found.coverage, marker, markersize=3, color=INK, label=name, fillstyle="none")
        axis.plot(t[found.rejected], found.coverage[found.rejected], "v", markersize=5, color=BAD)
    axis.set(
        xlabel="time on the observation clock [s]",
        ylim=(0, 1.05 * max(0.1, *(np.nanmax(f.coverage, initial=0) for f in report.frames.values()))),
    )
    axis.legend(fontsize=8)


def _nothing(axis: Any, why: str) -> None:
    axis.text(0.5, 0.5, why, ha="center", va="center", color=SOFT, transform=axis.transAxes)
    axis.set_axis_off()
