"""What screening would say without one of its parts: cases for development, most of which hide nothing.

Each case is fitted once; then its cells are screened as they are, and again with slow errors taken for white ones,
without what differs from episode to episode, beside a data sheet that does not give way, tested against zero, on one
mesh, and by tangents. What is "present" then is counted.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from torchcloth._files import write_text
from torchcloth.diagnosis import Fitted, Model, base_model, catalogue, fit, screen, setting_of
from torchcloth.diagnosis.approach import approach
from torchcloth.diagnosis.evidence import Evidence
from torchcloth.diagnosis.fitting import weighed
from torchcloth.diagnosis.setting import Setting
from torchcloth.errors import InvalidInput
from torchcloth.recordings import read
from torchcloth.recordings.together import together

from ..kept import Kept
from .checkout import module
from .fabric_tables import NOTHING, table

# numbers for development: a null and four hard ones; half of a drag, and wind
NULLS, SINGLES = (40, 42, 43, 44, 45), (6, 567)
NODES = 19  # of the truth's sides, half as many as in the round
NONE = 1e-9  # nearly, of a standard deviation
SMALL = 1e-2  # of a typical amplitude: a tangent at zero
ALL = "all parts"


def add(parser: argparse.ArgumentParser) -> None:
    """Options."""
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="cases at a time (1)")


def run(options: argparse.Namespace) -> None:
    """Compute what is missing, then print and write parts.json."""
    if options.jobs < 1:
        raise InvalidInput("--jobs", got=options.jobs, expected="1 or more")
    seeds = (*NULLS[:1], *SINGLES[:1]) if options.fast else (*NULLS, *SINGLES)
    kept = Kept(options.out, {"study": "parts", "fast": options.fast})
    work = {str(seed): partial(one, options.out, seed, options.fast) for seed in seeds}
    found = list(kept.run(work, options.jobs).values())
    path = write_text(options.out / "parts.json", json.dumps(found, indent=1, allow_nan=False) + "\n")
    show(found)
    print(f"result: {path}")


def one(out: Path, seed: int, fast: bool) -> dict[str, Any]:
    """What is hidden in a case, and what each way of screening calls present."""
    episodes = out / "episodes" / str(seed)
    how = ["--fast"] if fast else ["--nodes", str(NODES)]
    if not episodes.exists() and module("hidden", "make").main(["--seed", str(seed), "--out", str(episodes), *how]):
        raise InvalidInput("studies parts", got=f"case {seed} that could not be made", expected="its episodes")
    recordings = [read(path) for path in sorted(episodes.iterdir())]
    drawn = module("hidden", "drawn")
    truth = module("hidden", "reveal").truth(drawn.case(seed, drawn.SMALL if fast else drawn.REDUCED))
    model, setting = base_model(together(recordings)), setting_of(base_model(together(recordings)), recordings)
    asked = catalogue(model, recordings)
    near, before = approach(model, setting)
    fitted = fit(near, setting, asked, before=before)
    ways = {name: way(fitted) for name, way in WAYS.items()}
    ways["data sheet that does not give way"] = _rigid(fit(model, setting, asked, 0, before=before))
    ways["by tangents"] = _tangents(fitted, setting)
    return {
        "seed": seed,
        "family": truth["family"],
        "hidden": [e for e in truth["effects"] if e["share"] >= drawn.HALF],
        "ways": {name: [row for row in map(_told, screen(found)) if row] for name, found in ways.items()},
    }


def _told(row: Any) -> dict[str, Any] | None:
    if row.decision not in ("present", "inconclusive"):
        return None
    h = row.hypothesis
    return {"effect": h.name, "amplitude": row.amplitude, "std": row.total, "decision": row.decision}


def _white(found: Fitted) -> Fitted:
    """What neighbours and moments share is taken for independent."""
    noise = found.noise._replace(level=NONE * found.noise.level, depth=NONE * found.noise.depth)
    cells = [c._replace(rough=torch.zeros_like(c.rough)) for c in found.evidence.cells]
    return weighed(found.model, replace(found.evidence, cells=cells), noise)


def _alike(found: Fitted) -> Fitted:
    """Clock, camera, grasp, rim and tare are exact in every episode."""
    stds = [NONE * s for s in found.evidence.stds]
    return weighed(found.model, replace(found.evidence, stds=stds), found.noise)


def _rigid(found: Fitted) -> Fitted:
    """Fitted numbers lie at the data sheet, and stay there."""
    model = found.model
    narrow: Model = replace(model, parameters=[replace(p, std=NONE) for p in model.parameters])
    return weighed(narrow, found.evidence, found.noise)


def _against_zero(found: Fitted) -> Fitted:
    """Any amplitude matters."""
    anything = [replace(h, share=0.0) for h in found.evidence.hypotheses]
    return replace(found, evidence=replace(found.evidence, hypotheses=anything))


def _one_mesh(found: Fitted) -> Fitted:
    """Residuals on the mesh that slopes are taken on, and nobody knows of another."""
    evidence = found.evidence
    cells = [c._replace(value=c.value + n) for c, n in zip(evidence.cells, evidence.numerics, strict=True)]
    coarse: Evidence = replace(evidence, cells=cells, numerics=[torch.zeros_like(n) for n in evidence.numerics])
    return weighed(found.model, coarse, found.noise)


def _tangents(found: Fitted, setting: Setting) -> Fitted:
    """Slopes at a hundredth of a typical amplitude."""
    whole = found.evidence.hypotheses
    small = [replace(h, typical=SMALL * h.typical) for h in whole]
    near = fit(found.model, setting, small, 0, noise=found.noise, before=found.evidence)
    named = {h.name: h for h in whole}
    own = [named[h.name] for h in near.evidence.hypotheses]
    return replace(near, evidence=replace(near.evidence, hypotheses=own))


WAYS: Mapping[str, Callable[[Fitted], Fitted]] = {
    ALL: lambda found: found,
    "slow errors taken for white": _white,
    "episodes alike": _alike,
    "tested against zero": _against_zero,
    "on one mesh": _one_mesh,
}


def show(found: Sequence[Mapping[str, Any]]) -> None:
    """As a table: what is present that is not there, and whether what is there is."""
    from rich.console import Console

    nulls = [case for case in found if not case["hidden"]]
    others = [case for case in found if case["hidden"]]
    names = ["+".join(e["hypothesis"] for e in case["hidden"] if not e["beside"]) for case in others]
    headings = ("screened", *(f"{case['seed']}: nothing" for case in nulls), *names)
    filled = table("Present without being there (of what is: amplitude asked for / truth)", *headings, left=1)
    for way in found[0]["ways"]:
        filled.add_row(way, *(_counted(case, way) for case in (*nulls, *others)))
    console = Console(highlight=False, markup=False)
    console.width = max(console.width, 150)
    console.print(filled)


def _counted(case: Mapping[str, Any], way: str) -> str:
    """How many are present and not there, and how large what is there would be."""
    right = {name for e in case["hidden"] for name in (*e["names"], e["hypothesis"])}
    rows = [row for row in case["ways"][way] if row["decision"] == "present"]
    false = sum(row["effect"].partition("[")[0] not in right and row["effect"] not in right for row in rows)
    if not case["hidden"]:
        return str(false)
    sizes = [
        f"{row['amplitude'] / (e['amplitude'] * e['sign']):.2f}"
        for e in case["hidden"]
        for row in rows
        if row["effect"] == e["hypothesis"] and e["sign"] and not e["beside"]
    ]
    return f"{false} ({', '.join(sizes) or NOTHING})"
