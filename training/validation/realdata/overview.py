"""Run every adapter of measured data, write the recordings, print one table and draw pictures.

    python -m torchcloth.training.validation.realdata.overview --out DIR [--source DIR]

DIR then has an episode or table folder per run or specimen, overview.json, and a picture per source.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchcloth import recordings
from torchcloth.identification import Trellis, fit_tension

from . import bias_extension, cantilever, data_figures, diffcp_sample, knits, lifts, nylon, swings


@dataclass(frozen=True)
class OverviewRow:
    """One line of the table, as text.

    Attributes:
        source: of the data.
        content: number and kind of recordings.
        size: number of frames, points or rows.
        rejected: data that were left out.
        noise: of the measurement.
        estimate: what was estimated from the data.
        unknown: what the source does not say.
    """

    source: str
    content: str
    size: str
    rejected: str
    noise: str
    estimate: str
    unknown: str


def write_and_read_back(item: Any, path: Path) -> Any:
    """Write a recording or a tension table, and return what is read back."""
    if isinstance(item, recordings.ForceDisplacement):
        return recordings.read_tension(recordings.write_tension(item, path, overwrite=True))
    return recordings.read(recordings.write(item, path, overwrite=True))


def summarise_swings(source: Path, out: Path) -> OverviewRow:
    """Summarise the 30 runs."""
    episodes = {
        run: write_and_read_back(swings.read_episode(source, run), out / run) for run in swings.read_runs(source)
    }
    notes = [e.extra["notes"] for e in episodes.values()]
    rejected = [n["frames"]["rejected by arc length"] / n["frames"]["all"] for n in notes]
    noise = [1e3 * e.observation_noise_std for e in episodes.values()]
    lags = [-e.clock_offset for e in episodes.values()]
    data_figures.draw_swings(episodes, out.parent / "swings.png")
    return OverviewRow(
        "IRI swings",
        f"{len(episodes)} episodes",
        f"{sum(n['frames']['all'] for n in notes)} frames",
        f"{100 * np.median(rejected):.0f} % of frames ({100 * min(rejected):.0f} to {100 * max(rejected):.0f})",
        f"{np.median(noise):.1f} mm, normal ({min(noise):.1f} to {max(noise):.1f})",
        f"lag {np.median(lags):.3f} s (std over runs {np.std(lags):.3f})",
        "fabric, mass, thickness, stiffness",
    )


def summarise_lifts(source: Path, out: Path) -> OverviewRow:
    """Summarise the 7 lifts."""
    episodes = {
        trial: write_and_read_back(lifts.read_episode(source, trial), out / trial)
        for trial in lifts.list_trials(source)
    }
    counts = [e.extra["notes"]["points"] for e in episodes.values()]
    total = sum(c["all"] for c in counts)
    below = sum(c["below the crop"] for c in counts)
    outliers = sum(c["outliers, in frames that show the cloth"] for c in counts)
    frames = sum(len(e.points) for e in episodes.values())
    sides = np.array([lifts.measure_sides(source, trial) for trial in lifts.UNFOLDED_TRIALS])
    turns = np.degrees([lifts.fit_registration(source, trial)[0] for trial in episodes])
    uncropped = {trial: lifts.read_episode(source, trial, crop=False) for trial in episodes}
    data_figures.draw_lifts(uncropped, out.parent / "lifts.png")
    return OverviewRow(
        "lifted clouds",
        f"{len(episodes)} episodes",
        f"{frames} of {25 * len(episodes)} frames, {total} points",
        f"{100 * below / total:.2f} % below the crop, {100 * outliers / total:.2f} % outliers",
        "not known",
        f"side {sides.mean():.2f} m; camera rotated by {turns.mean():.1f} degrees (std over lifts {turns.std():.1f})",
        "fabrics, masses, lag, rotation of the gripper",
    )


def summarise_nylon(source: Path, out: Path) -> OverviewRow:
    """Summarise the four angles."""
    tables = {
        angle: write_and_read_back(table, out / f"angle{angle:02d}")
        for angle, table in nylon.read_tables(source).items()
    }
    fit = fit_tension(nylon.initial_cloth(), list(tables.values()), nylon.NYLON_PARAMETERS)
    data_figures.draw_nylon(tables, fit, out.parent / "nylon.png")
    worst = max(e["force_max_after"] for e in fit.errors)
    warp, weft, shear = (
        1e-3 * nylon.NYLON_NOMINAL_THICKNESS_M * fit.parameters[n].value for n in nylon.NYLON_PARAMETERS[:3]
    )
    return OverviewRow(
        "nylon off-axis",
        f"{len(tables)} tables",
        f"{sum(map(len, tables.values()))} rows",
        "none",
        "not known, no repeats",
        f"warp {warp:.1f}, weft {weft:.1f}, shear {shear:.2f} kN/m; at most {100 * worst:.1f} % off",
        "areal density, contraction",
    )


def summarise_knits(source: Path, out: Path) -> OverviewRow:
    """Summarise the 16 samples."""
    tables = {name: write_and_read_back(table, out / name) for name, table in knits.read_tables(source).items()}
    ratios = data_figures.draw_knits(knits.read_fabrics(source), out.parent / "knits.png")
    differences = [relative_strain_std(table, data_figures.MAX_FITTED_KNIT_FORCE_N) for table in tables.values()]
    return OverviewRow(
        "knits in tension",
        f"{len(tables)} tables",
        f"{sum(map(len, tables.values()))} rows, 3 repeats",
        f"width of {knits.SUSPECT_SAMPLE}",
        f"strain at {data_figures.MAX_FITTED_KNIT_FORCE_N:g} N differs by {100 * np.median(differences):.0f} % "
        f"(to {100 * max(differences):.0f})",
        f"Poisson's ratio {min(ratios):.2f} to {max(ratios):.2f}, up to 5 N",
        "areal density, thickness",
    )


def relative_strain_std(table: recordings.ForceDisplacement, force: float) -> float:
    """Return std over mean of the strains at which the repeats reach a force [N]."""
    pulls = [table.select_repeats(k) for k in knits.FITTED_REPEATS]
    strain = [pull.strain[np.argmax(pull.force >= force)] for pull in pulls]
    return float(np.std(strain, ddof=1) / np.mean(strain))


def summarise_bias_extension(source: Path, out: Path) -> OverviewRow:
    """Summarise the one specimen."""
    table = write_and_read_back(bias_extension.read_table(source), out / "glass_plain")
    shear = np.degrees(Trellis().angle(table).numpy())
    fit = fit_tension(
        bias_extension.initial_cloth(), table.select_rows(shear < 40), ["shear_modulus"], specimen=Trellis()
    )
    data_figures.draw_bias_extension(table, fit, out.parent / "bias_extension.png")
    modulus = fit.parameters["shear_modulus"].value
    return OverviewRow(
        "bias extension",
        "1 table",
        f"{len(table)} rows",
        "none",
        "not known, digitised",
        f"G h {bias_extension.GLASS_THICKNESS_M * modulus:.1f} N/m below 40 degrees",
        "yarn moduli, repeats",
    )


def summarise_cantilever(source: Path, out: Path) -> OverviewRow:
    """Summarise the one profile."""
    recording = write_and_read_back(cantilever.read_episode(source), out / "strip")
    line = cantilever.midline_profile(recording)
    roughness = line[:, 1] - np.polyval(np.polyfit(line[:, 0], line[:, 1], 6), line[:, 0])
    data_figures.draw_cantilever(line, cantilever.read_moment_table(source), out.parent / "cantilever.png")
    return OverviewRow(
        "cantilever",
        "1 episode",
        f"1 frame, {len(line)} points",
        "none",
        f"{1e3 * roughness.std():.2f} mm off a smooth curve",
        f"tip ({line[-1, 0]:.3f}, {line[-1, 1]:.3f}) m",
        "membrane stiffness",
    )


def summarise_diffcp(source: Path, out: Path) -> OverviewRow:
    """Summarise the sample of the paper's authors."""
    recording = write_and_read_back(diffcp_sample.read_recording(source), out / "dress")
    mesh = recording.extra["notes"]["mesh"]
    return OverviewRow(
        "DiffCP's sample",
        "1 episode",
        f"{len(recording.points)} frames, {len(recording.points.xyz)} points",
        f"{mesh['triangles_in_file'] - mesh['triangles_after_merging']} of {mesh['triangles_in_file']} triangles",
        "not known",
        f"pattern {mesh['area_of_pattern_m2']:.2f} m^2",
        "time base, thickness, stiffness",
    )


ADAPTERS = {
    "iri_cloth_swings": summarise_swings,
    "lifted_cloth_clouds": summarise_lifts,
    "nylon_offaxis_tension": summarise_nylon,
    "knit_tension": summarise_knits,
    "bias_extension": summarise_bias_extension,
    "cantilever": summarise_cantilever,
    "diffcp_sample": summarise_diffcp,
}


def summarise_sources(source: Path, out: Path) -> Iterator[OverviewRow]:
    """Yield one row per available source, as soon as it is finished."""
    for name, adapter in ADAPTERS.items():
        if (source / name).is_dir():
            (out / name).mkdir(parents=True, exist_ok=True)
            yield adapter(source / name, out / name)


def main() -> None:
    """Run the command line."""
    from rich import box
    from rich.console import Console
    from rich.progress import track
    from rich.table import Table

    parser = argparse.ArgumentParser(description="Summarise all measured data.")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--source", type=Path, help="default: $TORCHCLOTH_REALDATA")
    options = parser.parse_args()
    source = options.source or Path(os.environ.get("TORCHCLOTH_REALDATA", ""))
    if not any((source / name).is_dir() for name in ADAPTERS):
        parser.error("name the folder of measured data with --source, or set TORCHCLOTH_REALDATA")
    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    rows = list(track(summarise_sources(source, options.out), "adapters", total=len(ADAPTERS)))
    console = Console(highlight=False)
    console.width = 110
    table = Table(box=box.SIMPLE_HEAD, leading=1, pad_edge=False)
    for heading in ("source", "content", "size", "rejected", "noise", "estimate", "unknown"):
        table.add_column(heading, no_wrap=heading in ("source", "content"))
    for row in rows:
        table.add_row(*asdict(row).values())
    console.print(table)
    (options.out / "overview.json").write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n")
    print("pictures: " + ", ".join(sorted(str(p) for p in options.out.glob("*.png"))))


if __name__ == "__main__":
    main()
