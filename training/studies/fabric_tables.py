"""Tables of the fabric study, with the paper's numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from .paper_fabrics import FABRICS, SYMBOLS

PA_PER_KPA = 1e3
NO_VALUE = "–"
LAYER_SYMBOLS = ("k", "γ", "c_F")  # parameters of the contact between layers


def show(result: Mapping[str, Any]) -> None:
    """Print all tables and notes."""
    from rich.console import Console

    console = Console(highlight=False)
    console.width = max(console.width, 118)
    console.print(result["what"] + "\n", markup=False)
    console.print(_stretched(result))
    for line in _contact_notes(result):
        console.print(line, markup=False)
    console.print(_pressed(result))
    console.print(_placement_note(result), markup=False)
    for line in _promise_lines(result):
        console.print(line, markup=False)


def make_table(title: str, *headings: str, left: int = 2):
    """Return an empty table whose first ``left`` columns are left-aligned."""
    from rich import box
    from rich.table import Table

    out = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, min_width=len(title))
    for i, heading in enumerate(headings):
        out.add_column(heading, justify="left" if i < left else "right", no_wrap=True)
    return out


def make_markdown_table(headings: Sequence[str], rows: Sequence[Sequence[str]], left: int = 2) -> str:
    """Return a table as Markdown, whose first ``left`` columns are left-aligned."""
    rule = ["---" if k < left else "---:" for k in range(len(headings))]
    return "".join(f"| {' | '.join(line)} |\n" for line in (headings, rule, *rows))


def _stretched(result: Mapping[str, Any]):
    out = make_table(
        f"Stretching, {result['trials']} trials a fabric (E, k, γ in kPa; the truth is the paper's mean)",
        "fabric",
        "",
        "truth",
        "grand mean",
        "error",
        "CoV",
        "paper's CoV",
        "std. error",
        "95 % covers",
        "identified",
    )
    for name, entry in result["fabrics"].items():
        for symbol in SYMBOLS:
            f, s = entry[symbol], entry[symbol]["stretched"]
            first = [FABRICS[name] if symbol == "E" else "", symbol, format_value(f["truth"], symbol)]
            if s.get("mean") is None:
                out.add_row(*first, "not identifiable", "", "", format_percent(f["paper_cov"]), "", "", "")
            else:
                counts = f"{s['covered']}/{s['identifiable']}", f"{s['identifiable']}/{s['trials']}"
                shares = (
                    format_percent(s["error"], "+"),
                    format_percent(s["cov"]),
                    format_percent(f["paper_cov"]),
                    format_percent(s["std"]),
                )
                out.add_row(*first, format_value(s["mean"], symbol), *shares, *counts)
    return out


def _contact_notes(result: Mapping[str, Any]) -> list[str]:
    """Return notes on why a stretched sheet does not determine k and gamma."""
    fabrics = result["fabrics"].values()
    moved = max(entry[s]["stretched"]["tenth_mm"] for entry in fabrics for s in ("k", "γ"))
    first = next(iter(fabrics))
    return [
        f"k and γ act between layers only. A change of 10 % moves a stretched sheet by less than {1e3 * moved:.1g} µm, "
        "which is rounding error.",
        f"To determine k: {first['k']['stretched']['experiment']}; γ: {first['γ']['stretched']['experiment']}. "
        "Therefore two layers were pressed and slid over each other:\n",
    ]


def _pressed(result: Mapping[str, Any]):
    out = make_table(
        f"Press, {result['presses']} trials a fabric, plates where the model has them, and elsewhere in the grid",
        "fabric",
        "",
        "truth",
        "mean",
        "error",
        "CoV",
        "paper's CoV",
        "std. error",
        "elsewhere: error",
        "CoV",
    )
    for name, entry in result["fabrics"].items():
        for symbol in LAYER_SYMBOLS:
            f, p, e = entry[symbol], entry[symbol]["press"], entry[symbol]["elsewhere"]
            first = [FABRICS[name] if symbol == "k" else "", symbol, format_value(f["truth"], symbol)]
            here = (
                format_percent(p["error"], "+"),
                format_percent(p["cov"]),
                format_percent(f["paper_cov"]),
                format_percent(p["std"]),
            )
            mean = NO_VALUE if p["mean"] is None else format_value(p["mean"], symbol)
            out.add_row(*first, mean, *here, format_percent(e["error"], "+"), format_percent(e["cov"]))
    return out


def _placement_note(result: Mapping[str, Any]) -> str:
    """Return a note on the grid's influence."""
    every = {s: [entry[s]["elsewhere"]["worst"] for entry in result["fabrics"].values()] for s in LAYER_SYMBOLS}
    worst = {s: max((abs(x) for x in entry if x is not None), default=None) for s, entry in every.items()}
    off = ", ".join(f"{symbol} is off by up to {format_percent(share)}" for symbol, share in worst.items())
    return (
        f"Layers that are pressed elsewhere in the contact grid, and turned, give nearly the same force: {off}. The "
        "error bars count 3 % for it.\n"
    )


def _promise_lines(result: Mapping[str, Any]) -> list[str]:
    lines = []
    for promise, by_fabric in result["marks"].items():
        judged = {name: value for name, value in by_fabric.items() if value is not None}
        missed = ", ".join(FABRICS[name] for name, value in judged.items() if not value)
        lines.append(f"{promise}: {sum(judged.values())} of {len(judged)}" + (f"; not {missed}" if missed else ""))
    counts = []
    for symbol in ("E", "ν"):
        entry = [s for f in result["fabrics"].values() if (s := f[symbol]["stretched"])["covered"] is not None]
        counts.append(f"{sum(s['covered'] for s in entry)} of {sum(s['identifiable'] for s in entry)} of {symbol}")
    lines.append(f"95 % intervals contain the truth in {', '.join(counts)} (fits corrected for their mesh)")
    return [*lines, f"{result['seconds']:.0f} s a fit (median)"]


def format_value(value: float, symbol: str) -> str:
    """Format a modulus in kPa, or a number without a unit."""
    return f"{value:.3f}" if symbol in ("ν", "c_F") else f"{value / PA_PER_KPA:.1f}"


def format_percent(share: float | None, sign: str = "") -> str:
    """Format a fraction as a percentage."""
    return NO_VALUE if share is None else f"{100 * share:{sign}.2f} %"
