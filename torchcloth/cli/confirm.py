"""``torchcloth confirm``: compare a base and an extended model on held-out episodes."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .._utils.files import to_json, write_text
from .diagnose import show_progress_line
from .output_paths import check_output_folder, check_outside_episodes, output_path, replacement_note

if TYPE_CHECKING:
    from ..diagnosis import Gain


def add(verbs: Any) -> None:
    """Add the verb and its options."""
    parser = verbs.add_parser(
        "confirm",
        help="measure what an extended model gains on held-out episodes",
        description="Simulate each episode with both models and compare their distances from the observations. "
        "Neither model is fitted again. Episodes that a model was fitted to are refused.",
    )
    parser.add_argument("base", type=Path, metavar="BASE", help="a .tcm file, e.g. DIR/base.tcm of `diagnose`")
    parser.add_argument("extended", type=Path, metavar="EXTENDED", help="a .tcm file, e.g. DIR/extended.tcm")
    parser.add_argument("episodes", nargs="+", metavar="EPISODE", help="folders of episodes of the same cloth")
    parser.add_argument(
        "--out",
        type=output_path,
        metavar="DIR",
        help="folder for the result; an earlier result is replaced (default: confirmation/ beside EXTENDED)",
    )
    parser.set_defaults(run=_confirm)


def _confirm(options: argparse.Namespace) -> int:
    import torch

    from .. import diagnosis, recordings
    from ..diagnosis.run import CONFIRMATION_FILE

    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    out = options.extended.parent / CONFIRMATION_FILE.parent if options.out is None else options.out
    check_outside_episodes(out, *options.episodes)
    check_output_folder(out)
    episodes = [recordings.read(path) for path in options.episodes]
    with show_progress_line() as progress:
        confirmation = diagnosis.confirm(options.base, options.extended, episodes, progress)
    note = replacement_note(out / CONFIRMATION_FILE.name)
    path = write_text(out / CONFIRMATION_FILE.name, to_json(confirmation.as_dict()))
    _print(confirmation)
    print(f"result: {path}{note}")
    return 0


def _print(confirmation: Any) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    table = Table(title="Held-out episodes: misfit of both models", title_justify="left")
    for heading in ("motion", "base, mm", "extended, mm", "explained", "log density"):
        table.add_column(heading, justify="left" if heading == "motion" else "right")
    for name, gain in confirmation.gain_by_motion.items():
        table.add_row(escape(name), *_format_gain(gain))
    table.add_section()
    table.add_row("all", *_format_gain(confirmation.total_gain))
    console = Console()
    console.print(table)
    verdict = "The gain is confirmed" if confirmation.is_confirmed else "No gain is confirmed: an interval includes 0"
    floor = f"{1e3 * confirmation.noise_floor:.2f} mm ({confirmation.floor_source})"
    console.print(f"{verdict}. A correct model would leave {floor}.")


def _format_gain(gain: Gain) -> list[str]:
    low, high = gain.explained_fraction_ci95
    share, density = f"{100 * gain.explained_fraction:.0f} %", f"{gain.log_density:+.0f}"
    if gain.lower_bound_95 > -math.inf:  # else nothing is known of how it scatters
        share += f" ({100 * low:.0f} to {100 * high:.0f})"
        density += f" ({gain.log_density_ci95[0]:+.0f} to {gain.log_density_ci95[1]:+.0f})"
    if math.isnan(gain.rms_before):  # forces only
        return ["–", "–", "–", density]
    return [f"{1e3 * gain.rms_before:.2f}", f"{1e3 * gain.rms_after:.2f}", share, density]
