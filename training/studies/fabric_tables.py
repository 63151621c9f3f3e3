"""The fabric study as tables for a terminal, the paper's numbers beside ours."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from .paper_fabrics import FABRICS, SYMBOLS

KPA = 1e3
NOTHING = "–"
_LAYERS = ("k", "γ", "c_F")  # what shows between layers


def show(result: Mapping[str, Any]) -> None:
    """All tables and what they mean."""
    from rich.console import Console

    console = Console(highlight=False)
    console.width = max(console.width, 118)
    console.print(result["what"] + "\n", markup=False)
    console.print(_stretched(result))
    for line in _silent(result):
        console.print(line, markup=False)
    console.print(_pressed(result))
    console.print(_place(result), markup=False)
    for line in _marks(result):
        console.print(line, markup=False)


def table(title: str, *headings: str, left: int = 2):
    """An empty table; the first ``left`` columns are text."""
    from rich import box
    from rich.table import Table

    out = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, min_width=len(title))
    for i, heading in enumerate(headings):
        out.add_column(heading, justify="left" if i < left else "right", no_wrap=True)
    return out


def _stretched(result: Mapping[str, Any]):
    out = table(
        f"Stretching, {result['trials']} trials a fabric (E, k, γ in kPa; the truth is the paper's mean)",
        "fabric",
        "",
        "truth",
        "grand mean",
        "off by",
        "CoV",
        "paper's CoV",
        "std. err.",
        "95 % covers",
        "identified",
    )
    for name, own in result["fabrics"].items():
        for symbol in SYMBOLS:
            f, s = own[symbol], own[symbol]["stretched"]
            first = [FABRICS[name] if symbol == "E" else "", symbol, number(f["truth"], symbol)]
            if s.get("mean") is None:
                out.add_row(*first, "not identifiable", "", "", percent(f["paper_cov"]), "", "", "")
            else:
                counts = f"{s['covered']}/{s['identifiable']}", f"{s['identifiable']}/{s['trials']}"
                shares = percent(s["error"], "+"), percent(s["cov"]), percent(f["paper_cov"]), percent(s["std"])
                out.add_row(*first, number(s["mean"], symbol), *shares, *counts)
    return out


def _silent(result: Mapping[str, Any]) -> list[str]:
    """Why a stretched sheet says nothing of k and gamma."""
    fabrics = result["fabrics"].values()
    moved = max(own[s]["stretched"]["tenth_mm"] for own in fabrics for s in ("k", "γ"))
    first = next(iter(fabrics))
    return [
        f"k and γ act between layers only: 10 % of either moves a stretched sheet by less than {1e3 * moved:.1g} µm, "
        "the rounding of another step.",
        f"To determine k: {first['k']['stretched']['experiment']}; γ: {first['γ']['stretched']['experiment']}. "
        "So two layers were pressed and slid over each other:\n",
    ]


def _pressed(result: Mapping[str, Any]):
    out = table(
        f"Press, {result['presses']} trials a fabric, plates where the model has them; and elsewhere in the grid",
        "fabric",
        "",
        "truth",
        "mean",
        "off by",
        "CoV",
        "paper's CoV",
        "std. err.",
        "elsewhere: off by",
        "CoV",
    )
    for name, own in result["fabrics"].items():
        for symbol in _LAYERS:
            f, p, e = own[symbol], own[symbol]["press"], own[symbol]["elsewhere"]
            first = [FABRICS[name] if symbol == "k" else "", symbol, number(f["truth"], symbol)]
            here = percent(p["error"], "+"), percent(p["cov"]), percent(f["paper_cov"]), percent(p["std"])
            mean = NOTHING if p["mean"] is None else number(p["mean"], symbol)
            out.add_row(*first, mean, *here, percent(e["error"], "+"), percent(e["cov"]))
    return out


def _place(result: Mapping[str, Any]) -> str:
    """What the error bars of the press do not know."""
    every = {s: [own[s]["elsewhere"]["worst"] for own in result["fabrics"].values()] for s in _LAYERS}
    worst = {s: max((abs(x) for x in own if x is not None), default=None) for s, own in every.items()}
    off = ", ".join(f"{symbol} is off by up to {percent(share)}" for symbol, share in worst.items())
    return (
        "These errors know the sensors only. Pressed to the same distance elsewhere in the contact's grid, layers give "
        f"another force: {off}. k and γ are numbers of the grid as much as of the fabric.\n"
    )


def _marks(result: Mapping[str, Any]) -> list[str]:
    lines = []
    for promise, study in result["marks"].items():
        judged = {name: value for name, value in study.items() if value is not None}
        missed = ", ".join(FABRICS[name] for name, value in judged.items() if not value)
        lines.append(f"{promise}: {sum(judged.values())} of {len(judged)}" + (f"; not {missed}" if missed else ""))
    counts = []
    for symbol in ("E", "ν"):
        own = [s for f in result["fabrics"].values() if (s := f[symbol]["stretched"])["covered"] is not None]
        counts.append(f"{sum(s['covered'] for s in own)} of {sum(s['identifiable'] for s in own)} of {symbol}")
    lines.append(f"95 % intervals hold the truth in {', '.join(counts)}: fits corrected for their mesh")
    return [*lines, f"{result['seconds']:.0f} s a fit (median)"]


def number(value: float, symbol: str) -> str:
    """In kPa, or without a unit."""
    return f"{value:.3f}" if symbol in ("ν", "c_F") else f"{value / KPA:.1f}"


def percent(share: float | None, sign: str = "") -> str:
    """A share as a percentage."""
    return NOTHING if share is None else f"{100 * share:{sign}.2f} %"
