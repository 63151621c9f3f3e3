"""Scores and tables of the study of strangers' benches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ..validation.independent.stranger_bench import HOLDINGS
from .fabric_tables import NO_VALUE, make_markdown_table, make_table
from .honesty import PARAMETER_SYMBOLS, SUMMARY_HEADINGS, Answers, case_table, summarise

if TYPE_CHECKING:
    from rich.console import Console

DRAG = "air.normal"
STIFFNESSES = ("membrane_stiffness", "bending.stiffness")
ALL_HOLDINGS = "all"
HOLDING_WORDS = {"bar": "edge on a bar", "corners": "two corners", "corner": "one corner", ALL_HOLDINGS: "all"}
SCORE_HEADINGS = (
    "version",
    "held",
    "benches",
    *PARAMETER_SYMBOLS.values(),
    "drag",
    "E h or B",
    *SUMMARY_HEADINGS[3:],
)
QUALITY_HEADINGS = (
    "seed",
    "held",
    "camera",
    "points, mm",
    "no cloth",
    "first shape, mm",
    "clock, ms",
    "CPU s of new",
    "of inspect",
)


def score(answers: Answers) -> list[tuple[str, ...]]:
    """Return a row for each version and holding, and one for all holdings of a version."""
    rows = []
    for version, cases in answers.items():
        for holding in (*HOLDINGS, ALL_HOLDINGS):
            chosen = {seed: case for seed, case in cases.items() if holding in (case["holding"], ALL_HOLDINGS)}
            if not chosen:
                continue
            (summary,) = summarise({version: chosen})
            identified = [identifiable_names(case) for case in chosen.values()]
            counts = [str(sum(name in names for names in identified)) for name in PARAMETER_SYMBOLS]
            drag = sum(DRAG in names for names in identified) / len(chosen)
            stiffness = sum(bool(names.intersection(STIFFNESSES)) for names in identified) / len(chosen)
            shares = (f"{100 * share:.0f} %" for share in (drag, stiffness))
            rows.append((version, HOLDING_WORDS[holding], summary[1], *counts, *shares, *summary[3:]))
    return rows


def identifiable_names(case: Mapping[str, Any]) -> set[str]:
    """Return the names of the numbers that a fit calls identifiable."""
    return {name for name, e in case["parameters"].items() if e["identifiable"]}


def quality_rows(episodes: Mapping[int, Mapping[str, Any]]) -> list[tuple[str, ...]]:
    """Return a row for each episode: how far it is from the truth."""
    rows = []
    for seed, episode in episodes.items():
        quality, seconds = episode["quality"], (episode["seconds_new"], episode.get("seconds_inspect", 0.0))
        numbers = ("refused", *[NO_VALUE] * 3)
        if quality is not None:
            numbers = (
                f"{1e3 * quality['points_m']:.1f}",
                f"{100 * quality['foreign']:.1f} %",
                f"{1e3 * quality['first_shape_m']:.1f}",
                f"{1e3 * quality['clock_s']:+.0f}",
            )
        holding = HOLDING_WORDS[episode["holding"]]
        rows.append((str(seed), holding, episode["camera"], *numbers, *(f"{value:.0f}" for value in seconds)))
    return rows


def print_tables(answers: Answers, episodes: Mapping[int, Mapping[str, Any]]) -> None:
    """Print how far the episodes are from the truth, and the scores where there are fits."""
    from rich.console import Console

    console = Console(highlight=False)
    console.width = max(console.width, 190)
    quality = quality_rows(episodes)
    _print_table(console, "Episodes of torchcloth new against the truth", QUALITY_HEADINGS, quality, left=3)
    if answers:
        scores = score(answers)
        _print_table(console, "Benches where a number is called identifiable", SCORE_HEADINGS, scores, left=2)


def _print_table(
    console: Console, title: str, headings: Sequence[str], rows: Sequence[Sequence[str]], left: int
) -> None:
    from rich.markup import escape

    table = make_table(title, *headings, left=left)
    for row in rows:
        table.add_row(*map(escape, row))
    console.print(table)


def write_markdown(answers: Answers, episodes: Mapping[int, Mapping[str, Any]]) -> str:
    """Return the scores, every bench and every episode as tables in Markdown."""
    described = {
        version: {
            seed: {**case, "motion": f"{HOLDING_WORDS[case['holding']]}, {case['camera']}, {case['motion']}"}
            for seed, case in cases.items()
        }
        for version, cases in answers.items()
    }
    return "\n".join(
        (
            make_markdown_table(SCORE_HEADINGS, score(answers), left=2),
            case_table(described),
            make_markdown_table(QUALITY_HEADINGS, quality_rows(episodes), left=3),
        )
    )
