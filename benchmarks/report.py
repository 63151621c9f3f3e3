"""The measurements as tables, and as a plot of cost against size."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torchcloth._utils.files import write_atomically

COLUMNS = ("", "triangles", "substeps", "batch", "seconds", "ms/substep")


def show(result: dict[str, Any]) -> None:
    """Print tables on the terminal."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False)
    console.width = max(console.width, 112)
    console.print(
        "  ".join(f"{key} {value}" for key, value in result["machine"].items() if not isinstance(value, dict))
    )
    table = Table(title="Time", title_justify="left", box=box.SIMPLE_HEAD)
    for heading in COLUMNS:
        table.add_column(heading, justify="right" if heading else "left", no_wrap=True)
    for key, r in result["cases"].items():
        each = f"{r['ms_per_substep']:.4g}" if "ms_per_substep" in r else ""
        sizes = (str(r["triangles"]), str(r["substeps"]), str(r.get("batch") or ""))
        table.add_row(key, *sizes, f"{r['seconds']:.4g}", each)
    console.print(table)
    for key, r in result["cases"].items():
        if "peak_mebibytes" in r:
            console.print(f"{key}: {r['peak_mebibytes']:.0f} MiB above {r['base_mebibytes']:.0f} MiB")
    ratios = Table(title="Ratios", title_justify="left", box=box.SIMPLE_HEAD)
    ratios.add_column("")
    ratios.add_column("", justify="right")
    for name, value in result["ratios"].items():
        ratios.add_row(name, f"{value:.4g}")
    console.print(ratios)
    for engine, d in result["limits"].get("distance", {}).items():
        console.print(
            f"{engine}: {d['measured_ms']:.3g} ms a substep; the machine needs {d['arithmetic_ms']:.2g} ms for its "
            f"arithmetic and {d['memory_ms']:.2g} ms for its memory: {d['times_the_limit']:.3g} times the limit"
        )
    for name, text in result["conventions"].items():
        console.print(f"{name}: {text}", style="dim", markup=False)
    for key, note in result["notes"].items():
        console.print(f"{key}: {note}", style="yellow", markup=False)
    for name, remedy in result["missing_peers"].items():
        console.print(f"{name}: not installed ({remedy})", style="yellow", markup=False)


def plot(result: dict[str, Any], folder: Path) -> Path | None:
    """Plot cost against triangles and against substeps as ``folder``/bench.png; None without such records."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter

    records = result["cases"]
    series = {
        "triangles": sorted((r["triangles"], r["seconds"]) for key, r in records.items() if ".size." in key),
        "substeps": sorted((r["substeps"], r["seconds"]) for key, r in records.items() if ".steps-" in key),
    }
    if not all(len(points) > 1 for points in series.values()):
        return None
    figure = Figure(figsize=(9, 4), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (name, points) in zip(figure.subplots(1, 2), series.items(), strict=True):
        sizes, seconds = zip(*points, strict=True)
        axes.loglog(sizes, seconds, "o-", label="measured")
        axes.loglog(sizes, [seconds[0] * size / sizes[0] for size in sizes], "--", color="gray", label="proportional")
        axes.set(xlabel=name, ylabel="seconds of a forward run", title=f"cost by {name}")
        axes.set_xticks(sizes, [f"{size}" for size in sizes])
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.legend(frameon=False)
    path = folder / "bench.png"
    with write_atomically(path) as part:
        figure.savefig(part, dpi=150)
    return path
