"""An inspection as tables for a terminal."""

from __future__ import annotations

from typing import Any

import numpy as np

from .frame_checks import Frames
from .inspect_recording import Inspection

WIDTH = 100
MARKERS_SEEN = "share of the markers seen"
AREA_SEEN = "area seen over the cloth's, to 20 %, so 1 may be exceeded; far above 1: noise, or more than the cloth"
WITH_OUTLIERS = "outliers not removed"
STAGES = {"outliers": "alone, far from their neighbours", "clusters": "in small pieces apart from the cloth"}


def show(report: Inspection) -> None:
    """Streams, clocks, noise, frames and notes, 100 columns wide or more."""
    from rich.console import Console

    console = Console(highlight=False)
    console.width = max(console.width, WIDTH)
    console.print(f"{report.recording.path or 'recording'}: {report.recording.provenance}", style="bold", markup=False)
    _streams(console, report)
    _findings(console, report)
    for note in report.notes:
        console.print(f"note: {note}", style="yellow", markup=False)


def _table(title: str, columns: str) -> Any:
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD)
    for k, heading in enumerate(columns.split("|")):
        table.add_column(escape(heading.strip()), justify="right" if k > 1 else "left", no_wrap=k < 1)
    return table


def _row(table: Any, *cells: str) -> None:
    """A name in brackets is no markup."""
    from rich.markup import escape

    table.add_row(*map(escape, cells))


def _streams(console: Any, report: Inspection) -> None:
    table = _table(
        "Streams", "stream | kind | frames | from [s] | span [s] | rate [Hz] | largest gap [s] | gaps | jitter [s]"
    )
    for name, s in report.streams.items():
        numbers = (f"{s.start:.3f}", f"{s.span:.3f}", f"{s.rate:.2f}", f"{s.largest_gap:.3f}", str(s.gaps))
        _row(table, name, s.kind, str(s.frames), *numbers, f"{s.jitter:.4f}")
    console.print(table)


def _findings(console: Any, report: Inspection) -> None:
    table = _table("Findings", "what | value | ")
    table.columns[2].justify = "left"
    if (late := report.lag) is not None:
        value = f"{late.value:.3f} ± {late.std:.3f} s" if late.told else "not told"
        _row(table, "lag of the observations", value, f"recording says {late.stated:.3f} s")
    for name, n in report.noise.items():
        axes = "" if n.axes is None else "x y z " + " ".join(f"{1e3 * a:.1f}" for a in n.axes) + " mm; "
        _row(table, f"noise, {name}", f"{1e3 * n.std:.2f} mm", f"{axes}{n.frames} frames, {n.method}")
    for name, found in report.frames.items():
        _frames(table, name, found, report)
    for name, d in report.depth.items():
        detail = f"{d.near:.2f} … {d.middle:.2f} … {d.far:.2f} m, {d.looked_at} looked at"
        lens = ", lens distorts" if d.distorted else ""
        _row(table, f"depth without reading, {name}", f"{100 * d.invalid:.1f} %", detail + lens)
    console.print(table)


def _frames(table: Any, name: str, found: Frames, report: Inspection) -> None:
    count = int(found.rejected.sum())
    _row(table, f"rejected frames, {name}", f"{100 * found.rejected.mean():.1f} %", f"{count}, told by: {found.why}")
    if np.isfinite(found.coverage).any():
        least, usual, most = np.nanquantile(found.coverage, [0.0, 0.5, 1.0])
        meaning = MARKERS_SEEN if name == "markers" else AREA_SEEN if found.removed else f"{AREA_SEEN}, {WITH_OUTLIERS}"
        _row(table, f"coverage, {name}", f"{usual:.2f}", f"{least:.2f} to {most:.2f}, {meaning}")
    points = report.recording.points
    for stage, removed in found.removed.items():
        if points is not None:
            _row(
                table,
                f"{stage}, {name}",
                f"{100 * removed / len(points.xyz):.2f} %",
                f"{removed} points, {STAGES.get(stage, 'left out')}",
            )
    for bound, value in found.cuts.items():
        _row(table, f"cut off, {name}", f"{bound} {value:.4f} m", "most frames end there")
