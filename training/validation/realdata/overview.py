"""All measured data at a glance: runs every adapter, writes what it became, prints one table, draws pictures.

    python -m torchcloth.training.validation.realdata.overview --out DIR [--source DIR]

DIR then holds an episode or table folder per run or specimen, overview.json, and a picture per source.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from torchcloth import recordings
from torchcloth.identification import Trellis, fit_tension

from . import bias_extension, cantilever, data_figures, diffcp_sample, knits, lifts, nylon, swings


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    source: str
    became: str
    size: str
    rejected: str
    noise: str
    found: str
    unknown: str


def keep(item: recordings.Recording | recordings.ForceDisplacement, path: Path):
    """Write a recording or table, and return what is read back."""
    if isinstance(item, recordings.ForceDisplacement):
        return recordings.read_tension(recordings.write_tension(item, path, overwrite=True))
    return recordings.read(recordings.write(item, path, overwrite=True))


def of_swings(source: Path, out: Path) -> Row:
    """30 runs."""
    found = {run: keep(swings.episode(source, run), out / run) for run in swings.runs(source)}
    notes = [e.extra["notes"] for e in found.values()]
    rejected = [n["frames"]["rejected by arc length"] / n["frames"]["all"] for n in notes]
    noise = [1e3 * e.observation_noise_std for e in found.values()]
    lags = [-e.clock_offset for e in found.values()]
    data_figures.swings(found, out.parent / "swings.png")
    return Row(
        "IRI swings",
        f"{len(found)} episodes",
        f"{sum(n['frames']['all'] for n in notes)} frames",
        f"{100 * np.median(rejected):.0f} % of frames ({100 * min(rejected):.0f} to {100 * max(rejected):.0f})",
        f"{np.median(noise):.1f} mm, normal ({min(noise):.1f} to {max(noise):.1f})",
        f"lag {np.median(lags):.3f} s (runs differ by {np.std(lags):.3f})",
        "fabric, mass, thickness, stiffness",
    )


def of_lifts(source: Path, out: Path) -> Row:
    """7 lifts."""
    found = {trial: keep(lifts.episode(source, trial), out / trial) for trial in lifts.trials(source)}
    count = [e.extra["notes"]["points"] for e in found.values()]
    every = sum(c["all"] for c in count)
    below = sum(c["below the crop"] for c in count)
    outside = sum(c["outliers, in frames that show the cloth"] for c in count)
    used = sum(len(e.points) for e in found.values())
    sides = np.array([lifts.sides(source, trial) for trial in lifts.SPREAD])
    turns = np.degrees([lifts.register(source, trial)[0] for trial in found])
    data_figures.lifts({trial: lifts.episode(source, trial, crop=False) for trial in found}, out.parent / "lifts.png")
    return Row(
        "lifted clouds",
        f"{len(found)} episodes",
        f"{used} of {25 * len(found)} frames, {every} points",
        f"{100 * below / every:.2f} % below the crop, {100 * outside / every:.2f} % outliers",
        "not known",
        f"side {sides.mean():.2f} m; camera turned by {turns.mean():.1f} degrees (lifts differ by {turns.std():.1f})",
        "fabrics, masses, lag, gripper's turn",
    )


def of_nylon(source: Path, out: Path) -> Row:
    """Four angles."""
    found = {angle: keep(table, out / f"angle{angle:02d}") for angle, table in nylon.tables(source).items()}
    fit = fit_tension(nylon.start(), list(found.values()), nylon.NAMES)
    data_figures.nylon(found, fit, out.parent / "nylon.png")
    worst = max(e["force_max_after"] for e in fit.errors)
    warp, weft, shear = (1e-3 * nylon.H * fit.parameters[n].value for n in nylon.NAMES[:3])
    return Row(
        "nylon off-axis",
        f"{len(found)} tables",
        f"{sum(map(len, found.values()))} rows",
        "none",
        "not known, no repeats",
        f"warp {warp:.1f}, weft {weft:.1f}, shear {shear:.2f} kN/m; at most {100 * worst:.1f} % off",
        "areal density, contraction",
    )


def of_knits(source: Path, out: Path) -> Row:
    """16 samples."""
    found = {name: keep(table, out / name) for name, table in knits.tables(source).items()}
    ratios = data_figures.knits(knits.fabrics(source), out.parent / "knits.png")
    apart = [spread(table, data_figures.LIGHT) for table in found.values()]
    return Row(
        "knits in tension",
        f"{len(found)} tables",
        f"{sum(map(len, found.values()))} rows, 3 repeats",
        f"width of {knits.SUSPECT}",
        f"strain at {data_figures.LIGHT:g} N differs by {100 * np.median(apart):.0f} % (to {100 * max(apart):.0f})",
        f"Poisson's ratio {min(ratios):.2f} to {max(ratios):.2f}, up to 5 N",
        "areal density, thickness",
    )


def spread(table: recordings.ForceDisplacement, force: float) -> float:
    """Standard deviation over mean of the strain at which the repeats reach a force."""
    pulls = [table.repeats(k) for k in knits.REPEATS]
    strain = [pull.strain[np.argmax(pull.force >= force)] for pull in pulls]
    return float(np.std(strain, ddof=1) / np.mean(strain))


def of_bias_extension(source: Path, out: Path) -> Row:
    """One specimen."""
    table = keep(bias_extension.table(source), out / "glass_plain")
    shear = np.degrees(Trellis().angle(table).numpy())
    fit = fit_tension(bias_extension.start(), table.rows(shear < 40), ["shear_modulus"], specimen=Trellis())
    data_figures.bias_extension(table, fit, out.parent / "bias_extension.png")
    found = fit.parameters["shear_modulus"]
    return Row(
        "bias extension",
        "1 table",
        f"{len(table)} rows",
        "none",
        "not known, digitised",
        f"G h {bias_extension.THICKNESS * found.value:.1f} N/m below 40 degrees",
        "yarn moduli, repeats",
    )


def of_cantilever(source: Path, out: Path) -> Row:
    """One profile."""
    found = keep(cantilever.episode(source), out / "strip")
    line = cantilever.profile(found)
    rough = line[:, 1] - np.polyval(np.polyfit(*line.T, 6), line[:, 0])
    data_figures.cantilever(line, cantilever.moments(source), out.parent / "cantilever.png")
    return Row(
        "cantilever",
        "1 episode",
        f"1 frame, {len(line)} points",
        "none",
        f"{1e3 * rough.std():.2f} mm off a smooth curve",
        f"tip ({line[-1, 0]:.3f}, {line[-1, 1]:.3f}) m",
        "membrane stiffness",
    )


def of_diffcp(source: Path, out: Path) -> Row:
    """The sample of the paper's authors."""
    found = keep(diffcp_sample.convert(source), out / "dress")
    kept = found.extra["notes"]["mesh"]
    return Row(
        "DiffCP's sample",
        "1 episode",
        f"{len(found.points)} frames, {len(found.points.xyz)} points",
        f"{kept['triangles_in_file'] - kept['triangles_kept']} of {kept['triangles_in_file']} triangles",
        "not known",
        f"pattern {kept['area_of_pattern_m2']:.2f} m^2",
        "time base, thickness, stiffness",
    )


ADAPTERS = {
    "iri_cloth_swings": of_swings,
    "lifted_cloth_clouds": of_lifts,
    "nylon_offaxis_tension": of_nylon,
    "knit_tension": of_knits,
    "bias_extension": of_bias_extension,
    "cantilever": of_cantilever,
    "diffcp_sample": of_diffcp,
}


def rows(source: Path, out: Path) -> Iterator[Row]:
    """One row per source that is there, as soon as it is done."""
    for name, adapter in ADAPTERS.items():
        if (source / name).is_dir():
            (out / name).mkdir(parents=True, exist_ok=True)
            yield adapter(source / name, out / name)


def main() -> None:
    """Command line."""
    from rich import box
    from rich.console import Console
    from rich.progress import track
    from rich.table import Table

    parser = argparse.ArgumentParser(description="All measured data at a glance.")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--source", type=Path, help="default: $TORCHCLOTH_REALDATA")
    options = parser.parse_args()
    source = options.source or Path(os.environ.get("TORCHCLOTH_REALDATA", ""))
    if not any((source / name).is_dir() for name in ADAPTERS):
        parser.error("name the folder of measured data with --source, or set TORCHCLOTH_REALDATA")
    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    done = list(track(rows(source, options.out), "adapters", total=len(ADAPTERS)))
    console = Console(highlight=False)
    console.width = 110
    table = Table(box=box.SIMPLE_HEAD, leading=1, pad_edge=False)
    for heading in ("source", "became", "size", "rejected", "noise", "found", "not known"):
        table.add_column(heading, no_wrap=heading in ("source", "became"))
    for row in done:
        table.add_row(*asdict(row).values())
    console.print(table)
    (options.out / "overview.json").write_text(json.dumps([asdict(row) for row in done], indent=1) + "\n")
    print("pictures: " + ", ".join(sorted(str(p) for p in options.out.glob("*.png"))))


if __name__ == "__main__":
    main()
