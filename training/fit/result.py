"""Result of a run: fit.json, fields.npz and a table."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import numpy as np

from torchcloth._utils.files import to_json, write_atomically, write_text

from .config import Config
from .learned_cloth import scalar_summary
from .module import FitModule

RESULT_FILES = ("fit.json", "fields.npz")
NO_ERROR_BARS_REMARK = (
    "Gradient descent gives values without error bars, so nothing here says how well the data determine them. For "
    "standard errors and identifiability, start `identify` from these values. Fields and networks have no error bars."
)
CONVENTION = (
    "SI units. chamfer: one-sided, cloud to surface: mean distance [m] from each measured point to the nearest point "
    "of the simulated triangles, mean over all frames but the first and over the episodes. history: values before each "
    "step and the losses with them; for a field, its mean."
)


def write_result(
    folder: Path,
    config: Config,
    module: FitModule,
    initial: dict[str, float],
    figures: dict[str, Any],
    episodes: list[str],
) -> dict[str, Any]:
    """Write fit.json and, if fields were learned, fields.npz.

    Returns:
        The content of fit.json.
    """
    values, fields = module.learned.values(), {}
    parameters: dict[str, Any] = {}
    for name, value in values.items():
        entry = {"value": scalar_summary(value), "unit": module.learned.parameter(name).unit, "initial": initial[name]}
        if value.ndim:
            fields[name] = value.numpy()
            entry |= {"field": "fields.npz", "minimum": float(value.min()), "maximum": float(value.max())}
        parameters[name] = entry
    content = {
        "schema": "torchcloth.fit/1",
        "parameters": parameters,
        "remark": NO_ERROR_BARS_REMARK,
        "identify_command": _identify_command(
            config, episodes, {n: p["value"] for n, p in parameters.items() if "field" not in p}
        ),
        **figures,
        "convention": CONVENTION,
        "history": [{"step": step, **entry} for step, entry in sorted(module.history.items())],
    }
    if fields:
        with write_atomically(folder / "fields.npz") as part:
            np.savez(part, **fields)
    else:
        (folder / "fields.npz").unlink(missing_ok=True)  # of an earlier run
    write_text(folder / "fit.json", to_json(content))
    return content


def _identify_command(config: Config, episodes: list[str], values: dict[str, float]) -> str | None:
    """Return the command that computes error bars from here; None if there are no scalars."""
    if not values:
        return None
    starts = {**config.model.start, **values}
    words = ["torchcloth", "identify", *episodes, "--out", str(config.folder / "identify")]
    words += ["--start", *(f"{name}={value:.6g}" for name, value in starts.items()), "--fit", *values]
    given = {"--contact": config.model.contact, "--dt": config.model.dt}
    words += [word for option, value in given.items() if value for word in (option, f"{value:g}")]
    return shlex.join(words)


def print_result(content: dict[str, Any], folder: Path) -> None:
    """Print the result as a table."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title="learned", title_justify="left")
    for column, side in (("parameter", "left"), ("unit", "left"), ("start", "right"), ("fitted", "right")):
        table.add_column(column, justify=side)  # type: ignore[arg-type]
    for name, p in content["parameters"].items():
        now = f"{p['value']:.4g}"
        now += f" (mean; {p['minimum']:.4g} to {p['maximum']:.4g})" if "field" in p else ""
        table.add_row(name, p["unit"], f"{p['initial']:.4g}", now)
    console = Console()
    console.print(table)
    for kind in ("train", "val"):
        after = content[kind].get("chamfer_after")
        if after is not None:
            before = content[kind].get("chamfer_before")
            start = "" if before is None else f", {1e3 * before:.2f} mm before"
            console.print(f"{kind}: {1e3 * after:.2f} mm from the points to the surface{start}")
    for warning in content["warnings"]:
        console.print(f"warning: {warning}", style="yellow", soft_wrap=True)
    command = content["identify_command"]
    console.print(NO_ERROR_BARS_REMARK, "" if command is None else f"\n  {command}", style="dim", soft_wrap=True)
    console.print(f"result:   {folder / 'fit.json'}", soft_wrap=True)
