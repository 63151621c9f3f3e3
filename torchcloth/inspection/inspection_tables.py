"""Print an inspection as tables."""

from __future__ import annotations

from typing import Any

import numpy as np

from .frame_checks import FrameChecks
from .inspect_recording import Inspection

MIN_CONSOLE_WIDTH = 100
MARKER_COVERAGE_TEXT = "fraction of the markers seen"
CLOUD_COVERAGE_TEXT = "area seen / cloth area, to 20 %, so it may exceed 1; far above 1: noise, or more than the cloth"
OUTLIERS_KEPT_TEXT = "outliers not removed"
STAGE_TEXT = {"outliers": "far from their neighbours", "clusters": "in small clusters apart from the cloth"}


def show(report: Inspection) -> None:
    """Print streams, notes, lag, noise and frames, at least 100 columns wide."""
    from rich.console import Console

    console = Console(highlight=False)
    console.width = max(console.width, MIN_CONSOLE_WIDTH)
    console.print(f"{report.recording.path or 'recording'}: {report.recording.provenance}", style="bold", markup=False)
    _streams(console, report)
    for note in report.notes:
        console.print(f"note: {note}", style="yellow", markup=False)
    _findings(console, report)


def _table(title: str, columns: str) -> Any:
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    for k, heading in enumerate(columns.split("|")):
        table.add_column(escape(heading.strip()), justify="right" if k > 1 else "left", no_wrap=k < 1)
    return table


def _add_row(table: Any, *cells: str) -> None:
    """Add a row whose cells are no markup, e.g. a name in brackets."""
    from rich.markup import escape

    table.add_row(*map(escape, cells))


def _streams(console: Any, report: Inspection) -> None:
    table = _table(
        "Streams", "stream | kind | frames | first [s] | span [s] | rate [Hz] | largest gap [s] | gaps | jitter [s]"
    )
    for name, s in report.streams.items():
        numbers = (f"{s.start:.3f}", f"{s.span:.3f}", f"{s.rate:.2f}", f"{s.largest_gap:.3f}", str(s.gaps))
        _add_row(table, name, s.kind, str(s.frames), *numbers, f"{s.jitter:.4f}")
    console.print(table)


def _findings(console: Any, report: Inspection) -> None:
    table = _table("Findings", "what | value | ")
    table.columns[2].justify = "left"
    if (lag := report.lag) is not None:
        value = f"{lag.value:.3f} ± {lag.std:.3f} s" if lag.is_determined else "not determined"
        _add_row(table, "lag of the observations", value, f"recording says {lag.recorded:.3f} s")
    for name, n in report.noise.items():
        axes = "" if n.std_xyz is None else "x y z " + " ".join(f"{1e3 * a:.1f}" for a in n.std_xyz) + " mm; "
        _add_row(table, f"noise, {name}", f"{1e3 * n.std:.2f} mm", f"{axes}{n.frames} frames, {n.method}")
    if (patch := report.patch_noise) is not None:
        value = "–" if patch.std is None else f"{1e3 * patch.std:.2f} mm"
        frames = f"{patch.frames} frames, " if patch.frames else ""
        _add_row(table, "noise shared by neighbours", value, f"{frames}{patch.method}")
    if report.frozen:
        detail = "clouds equal the one before bit for bit: the camera was frozen"
        _add_row(table, "frozen clouds", f"{len(report.frozen)}", f"of {report.streams['points'].frames} {detail}")
    for name, checks in report.frames.items():
        _add_frame_rows(table, name, checks, report)
    for name, d in report.depth.items():
        detail = f"{d.near:.2f} … {d.median:.2f} … {d.far:.2f} m, {d.decoded_images} images decoded"
        lens = ", lens distorts" if d.has_distortion else ""
        _add_row(table, f"invalid depth pixels, {name}", f"{100 * d.invalid_fraction:.1f} %", detail + lens)
    console.print(table)


def _add_frame_rows(table: Any, name: str, checks: FrameChecks, report: Inspection) -> None:
    count = int(checks.rejected.sum())
    fraction = f"{100 * checks.rejected.mean():.1f} %"
    _add_row(table, f"rejected frames, {name}", fraction, f"{count}, criterion: {checks.criterion}")
    if np.isfinite(checks.coverage).any():
        lowest, typical, highest = np.nanquantile(checks.coverage, [0.0, 0.5, 1.0])
        meaning = MARKER_COVERAGE_TEXT if name == "markers" else CLOUD_COVERAGE_TEXT
        if name != "markers" and not checks.removed:
            meaning = f"{meaning}, {OUTLIERS_KEPT_TEXT}"
        _add_row(table, f"coverage, {name}", f"{typical:.2f}", f"{lowest:.2f} to {highest:.2f}, {meaning}")
    points = report.recording.points
    for stage, removed in checks.removed.items():
        if points is not None:
            _add_row(
                table,
                f"{stage}, {name}",
                f"{100 * removed / len(points.xyz):.2f} %",
                f"{removed} points, {STAGE_TEXT.get(stage, 'left out')}",
            )
    for bound, value in checks.crop_planes.items():
        _add_row(table, f"cropped, {name}", f"{bound} {value:.4f} m", "most frames end there")
