"""Tables and picture of the study of poses from a network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchcloth._utils.files import save_figure

from .fabric_tables import NO_VALUE, make_markdown_table, make_table
from .hidden_rates import Rate

Results = Mapping[int, Mapping[str, Any]]  # seed -> facts and methods
MEDIAN_BOOTSTRAP_DRAWS, BOOTSTRAP_SEED = 2000, 0
COMBINED_PREFIX = "network + simulation"
METHOD_HEADINGS = (
    "method",
    "all, mm (95 %)",
    "hidden, mm (95 %)",
    "first, mm",
    "farther off in",
    "in 95 %",
    "std., mm",
    "30 % hidden, mm",
    "CPU",
)
EPISODE_FACTS = ("grip", "motion", "camera")


def bootstrap_median(values: Sequence[float]) -> tuple[float, float, float]:
    """Return the median and its 95 % percentile interval over the episodes."""
    numbers = np.asarray(values, dtype=float)
    rng = np.random.default_rng(BOOTSTRAP_SEED)
    drawn = numbers[rng.integers(0, len(numbers), (MEDIAN_BOOTSTRAP_DRAWS, len(numbers)))]
    low, high = np.quantile(np.median(drawn, axis=1), [0.025, 0.975])
    return float(np.median(numbers)), float(low), float(high)


def method_names(results: Results) -> list[str]:
    """Return the methods in their order."""
    return list(next(iter(results.values()))["methods"])


def compare(results: Results, combined: str, method: str) -> Rate:
    """Count the episodes in which the combination is nearer to the truth than another method; a failure is farther."""
    pairs = [(_rms(r, combined), _rms(r, method)) for r in results.values()]
    return Rate(sum(a < b for a, b in pairs), len(pairs))


def _rms(result: Mapping[str, Any], method: str) -> float:
    value = result["methods"][method].get("rms")
    return np.inf if value is None else float(value)


def _combination(method: str, networks: Sequence[str]) -> str | None:
    """Return the combination that a method is compared with; None: it is one, or there is none."""
    if not networks or method.startswith(COMBINED_PREFIX):
        return None
    label = next((name for name in networks if name and method.endswith(f"({name})")), networks[0])
    return f"{COMBINED_PREFIX} ({label})" if label else COMBINED_PREFIX


def _method_rows(results: Results, networks: Sequence[str]) -> list[tuple[str, ...]]:
    return [(name, *_method_cells(results, name, networks)) for name in method_names(results)]


def _method_cells(results: Results, name: str, networks: Sequence[str]) -> tuple[str, ...]:
    cases = [r["methods"][name] for r in results.values()]
    good = [c for c in cases if "failed" not in c]
    if not good:
        return ("failed", *[NO_VALUE] * (len(METHOD_HEADINGS) - 2))
    combined = _combination(name, networks)
    better = NO_VALUE
    if combined is not None:
        rate = compare(results, combined, name)
        better = f"{rate.hits} of {rate.of}"
    clouds = [rms for c in good for rms in c["rms_of_much_hidden_clouds"]] if "ms_per_cloud" in good[0] else []
    if "ms_per_cloud" in good[0]:
        cost = f"{np.median([c['ms_per_cloud'] for c in good]):.0f} ms a cloud"
    else:
        cost = f"{np.median([c['cpu_seconds'] for c in good]):.0f} s"
    failed = f", {len(cases) - len(good)} failed" if len(good) < len(cases) else ""
    return (
        _interval([c["rms"] for c in good]) + failed,
        _interval([c["rms_hidden"] for c in good if c["rms_hidden"] is not None]),
        f"{1e3 * np.median([c['rms_first'] for c in good]):.1f}",
        better,
        _mean(good, "coverage", 100, "{:.0f} %"),
        _median_std(good),
        f"{1e3 * np.median(clouds):.1f}" if clouds else NO_VALUE,
        cost,
    )


def _median_std(cases: Sequence[Mapping[str, Any]]) -> str:
    """Median standard deviation [mm]: that of a shape of which nothing is known has no bound."""
    stds = [case["std_rms"] for case in cases if "std_rms" in case]
    return f"{1e3 * np.median(stds):.1f}" if stds else NO_VALUE


def _interval(values: Sequence[float]) -> str:
    if not values:
        return NO_VALUE
    median, low, high = (1e3 * value for value in bootstrap_median(values))
    return f"{median:.1f} ({low:.1f} to {high:.1f})"


def _mean(cases: Sequence[Mapping[str, Any]], key: str, factor: float, form: str) -> str:
    values = [c[key] for c in cases if c.get(key) is not None]
    return form.format(factor * float(np.mean(values))) if values else NO_VALUE


def _episode_headings(results: Results) -> tuple[str, ...]:
    return ("seed", *EPISODE_FACTS, "hidden", *method_names(results))


def _episode_rows(results: Results) -> list[tuple[str, ...]]:
    rows = []
    for seed, result in results.items():
        methods, facts = result["methods"], result["facts"]
        hidden = f"{100 * next(iter(methods.values()))['hidden_share']:.0f} %"
        cells = ["failed" if "failed" in c else f"{1e3 * c['rms']:.1f}" for c in methods.values()]
        rows.append((str(seed), *(facts[name] for name in EPISODE_FACTS), hidden, *cells))
    return rows


def print_tables(results: Results, networks: Sequence[str]) -> None:
    """Print the methods, then every episode."""
    from rich.console import Console
    from rich.markup import escape

    console = Console(highlight=False)
    console.width = max(console.width, 190)
    table = make_table("Distance from the truth: median over the episodes", *METHOD_HEADINGS, left=1)
    for row in _method_rows(results, networks):
        table.add_row(*map(escape, row))
    episodes = make_table(
        "Distance over frames and vertices, root mean square [mm]", *_episode_headings(results), left=4
    )
    for row in _episode_rows(results):
        episodes.add_row(*map(escape, row))
    console.print(table)
    console.print(episodes)


def to_markdown(results: Results, networks: Sequence[str]) -> str:
    """Return the tables as Markdown."""
    methods = make_markdown_table(METHOD_HEADINGS, _method_rows(results, networks), 1)
    return methods + "\n" + make_markdown_table(_episode_headings(results), _episode_rows(results), 4)


def write_picture(results: Results, path: Path) -> Path:
    """Draw the distance of every episode by method, with the medians."""
    from matplotlib.figure import Figure

    names = method_names(results)
    figure = Figure(figsize=(1.6 + 1.25 * len(names), 3.6), layout="constrained")
    axis = figure.subplots()
    for k, name in enumerate(names):
        cases = [r["methods"][name] for r in results.values()]
        values = 1e3 * np.array([c["rms"] for c in cases if "failed" not in c], dtype=float)
        spread = np.linspace(-0.22, 0.22, len(values)) if len(values) > 1 else np.zeros(len(values))
        axis.plot(k + spread, values, "o", ms=4, alpha=0.6, color="#1f6f8b")
        if len(values):
            axis.hlines(np.median(values), k - 0.3, k + 0.3, color="#b0653a")
    axis.set(yscale="log", ylabel="distance from the truth [mm]", xticks=range(len(names)))
    axis.set_xticklabels([name.replace(", ", ",\n").replace(" + ", " +\n") for name in names], fontsize=8)
    axis.grid(alpha=0.3, axis="y", which="both")
    return save_figure(figure, path)
