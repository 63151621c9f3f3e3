"""Figure of an inspection: time stamps, lag, two frames and coverage."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .._utils.files import save_figure
from ..observe import decode_depth
from ..recordings.timing import GAP_FACTOR, stream_times
from .inspect_recording import Inspection

DATA_COLOUR, WARNING_COLOUR, MUTED_COLOUR = "#1f6f8b", "#b0653a", "#888888"
MAX_POINTS_PER_PANEL = 3000  # of one frame


def draw(report: Inspection, folder: str | Path) -> Path:
    """Write inspection.png into a folder, atomically.

    Returns:
        The path of the picture.
    """
    from matplotlib.figure import Figure

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(15, 9))
    grid = figure.add_gridspec(
        2, 3, height_ratios=[1, 1.5], hspace=0.3, wspace=0.2, top=0.9, bottom=0.07, left=0.06, right=0.98
    )
    _timeline(figure.add_subplot(grid[0, :2]), report)
    _lag_curve(figure.add_subplot(grid[0, 2]), report)
    drawn_frames = _frames_to_draw(report)
    if not drawn_frames:
        _images([figure.add_subplot(grid[1, column]) for column in (0, 1)], report)
    for column, (kind, i) in enumerate(drawn_frames):
        _frame(figure.add_subplot(grid[1, column], projection="3d"), report, kind, i)
    _coverage(figure.add_subplot(grid[1, 2]), report)
    name = report.recording.path.name if report.recording.path else "recording"
    figure.suptitle(f"{name}: {report.recording.provenance}", fontsize=11, parse_math=False)
    return save_figure(figure, folder / "inspection.png")


def _timeline(axis: Any, report: Inspection) -> None:
    """Draw a tick for each frame, and gaps and rejected frames in another colour."""
    streams = stream_times(report.recording)
    shift = _observation_to_motion_s(report)
    for row, (name, (kind, t)) in enumerate(streams.items()):
        motion_time = t if kind in ("motion", "joints", "motion + joints") else t + shift
        axis.vlines(motion_time, row - 0.35, row + 0.35, color=DATA_COLOUR, linewidth=0.6)
        intervals = np.diff(t)
        for k in np.flatnonzero(intervals > GAP_FACTOR * np.median(intervals)) if len(intervals) else []:
            axis.plot(motion_time[k : k + 2], [row, row], color=WARNING_COLOUR, linewidth=3, solid_capstyle="butt")
        if name in report.frames:
            axis.plot(
                motion_time[report.frames[name].rejected],
                np.full(report.frames[name].rejected.sum(), row + 0.42),
                "v",
                color=WARNING_COLOUR,
                markersize=4,
            )
    axis.set_yticks(range(len(streams)), list(streams), parse_math=False)
    axis.set(xlabel="time on the motion clock [s]")
    axis.set_title("time stamps of the streams (bars: gaps, triangles: rejected frames)", fontsize=10)
    axis.invert_yaxis()


def _observation_to_motion_s(report: Inspection) -> float:
    """Return the shift [s] from the observation clock to the motion clock."""
    return report.recording.clock_offset if report.lag is None else -report.lag.effective


def _lag_curve(axis: Any, report: Inspection) -> None:
    axis.set_title("lag of the observations", fontsize=10)
    lag = report.lag
    if lag is None:
        return _write_reason(axis, "no motion, or too few observations")
    axis.plot(lag.candidates, 1e3 * lag.cost, color=DATA_COLOUR)
    axis.axvline(lag.recorded, color=MUTED_COLOUR, linestyle="--", label=f"recording says {lag.recorded:.3f} s")
    if lag.is_determined:
        axis.axvspan(lag.value - 2 * lag.std, lag.value + 2 * lag.std, color=WARNING_COLOUR, alpha=0.25)
        axis.axvline(lag.value, color=WARNING_COLOUR, label=f"estimate {lag.value:.3f} ± {lag.std:.3f} s")
    axis.set(xlabel="candidate lag [s]", ylabel="misfit of the gripped cloth [mm]")
    axis.locator_params(axis="x", nbins=5)
    axis.legend(fontsize=8)


def _frames_to_draw(report: Inspection) -> list[tuple[str, int]]:
    """Return two accepted frames at one and two thirds of the time, of markers or else of clouds."""
    for kind in ("markers", "points"):
        if kind in report.frames:
            good = np.flatnonzero(~report.frames[kind].rejected)
            if len(good):
                return [(kind, int(good[len(good) * k // 3])) for k in (1, 2)]
    return []


def _images(axes: list[Any], report: Inspection) -> None:
    """Draw two depth images of a camera, if there are no points or markers to draw."""
    depth_streams = [
        (name, camera.depth, camera.depth_scale)
        for name, camera in report.recording.cameras.items()
        if name in report.depth and camera.depth is not None and camera.depth_scale is not None
    ]
    for share, axis in zip((1, 2), axes, strict=True):
        if not depth_streams:
            _write_reason(
                axis, "no good frame" if report.frames else "nothing to draw: no points, no markers, no depth"
            )
            continue
        name, images, scale = depth_streams[0]
        i = len(images) * share // 3
        depth = decode_depth(images.load(i), scale)
        drawn_frames = axis.imshow(np.where(depth > 0, depth, np.nan), cmap="viridis")
        axis.figure.colorbar(drawn_frames, ax=axis, shrink=0.6, label="depth [m]")
        axis.set(xticks=[], yticks=[])
        axis.set_title(f"{name}, depth image {i}", fontsize=10, parse_math=False)


def _frame(axis: Any, report: Inspection, kind: str, i: int) -> None:
    """Draw a frame with the grippers' positions and paths."""
    recording = report.recording
    stream = getattr(recording, kind)
    cloud = stream.xyz[i] if kind == "markers" else stream.frame(i)
    cloud = cloud[np.isfinite(cloud[:, 0])]
    cloud = cloud[:: max(1, len(cloud) // MAX_POINTS_PER_PANEL)]
    t = stream.t[i] + _observation_to_motion_s(report)
    axis.scatter(*cloud.T, s=6 if len(cloud) < 500 else 1, color=DATA_COLOUR, depthshade=False)
    extents = [cloud]
    for name, path in report.paths.items():
        axis.plot(*path.position.T, color=MUTED_COLOUR, linewidth=0.8)
        position = path.at(np.array([t]))[0]
        axis.scatter(*position.T, s=40, color=WARNING_COLOUR, marker="s", depthshade=False)
        axis.text(*position[0], f" {name}", fontsize=7, color=WARNING_COLOUR, parse_math=False)
        extents.append(path.position)
    points = np.concatenate(extents)
    middle, half = (points.max(0) + points.min(0)) / 2, max(np.ptp(points, axis=0).max() / 2, 1e-3)
    axis.set(**{f"{a}lim": (m - half, m + half) for a, m in zip("xyz", middle, strict=True)})
    axis.set_box_aspect((1, 1, 1), zoom=1.1)
    axis.tick_params(labelsize=6, pad=-2)
    axis.locator_params(nbins=4)
    for name in "xyz":
        getattr(axis, f"set_{name}label")(f"{name} [m]", fontsize=7, labelpad=-8)
    axis.set_title(f"{kind}, frame {i}, t = {stream.t[i]:.2f} s", fontsize=10, parse_math=False)


def _coverage(axis: Any, report: Inspection) -> None:
    """Draw the coverage of each frame."""
    axis.set_title("coverage by frame", fontsize=10)
    if not any(np.isfinite(f.coverage).any() for f in report.frames.values()):
        return _write_reason(axis, "nothing observed, or the cloth's size is unknown")
    for (name, checks), marker in zip(report.frames.items(), "os", strict=False):
        t = getattr(report.recording, name).t
        axis.plot(t, checks.coverage, marker, markersize=3, color=DATA_COLOUR, label=name, fillstyle="none")
        axis.plot(t[checks.rejected], checks.coverage[checks.rejected], "v", markersize=5, color=WARNING_COLOUR)
    axis.set(
        xlabel="time on the observation clock [s]",
        ylim=(0, 1.05 * max(0.1, *(np.nanmax(f.coverage, initial=0) for f in report.frames.values()))),
    )
    axis.legend(fontsize=8)


def _write_reason(axis: Any, reason: str) -> None:
    axis.text(0.5, 0.5, reason, ha="center", va="center", color=MUTED_COLOUR, transform=axis.transAxes)
    axis.set_axis_off()
