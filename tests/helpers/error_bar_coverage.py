"""Do the error bars hold the truth? Seeded twins with other mesh, grid, step and values than the model.

    PYTHONPATH=tests python -m helpers.error_bar_coverage OUT.jsonl [--twins 48] [--first 0] [--refine]

Each twin adds one line; a run that was stopped goes on where it was. The table is printed at the end.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from pathlib import Path

import numpy as np
import torch

from helpers import stretched_sheets
from torchcloth.identification import identify

FITTED_PARAMETERS = ("youngs_modulus", "poisson_ratio", "air.normal")


def draw_fabric(seed: int) -> stretched_sheets.Fabric:
    """Drawn around the default; the study's own random numbers."""
    rng = np.random.default_rng(10_000 + seed)
    return stretched_sheets.Fabric(
        membrane=60.0 * 1.5 ** rng.uniform(-1, 1), poisson=rng.uniform(0.2, 0.4), drag=rng.uniform(0.8, 1.6)
    )


def true_values(given: stretched_sheets.Fabric) -> dict[str, float]:
    """By the names of the fit."""
    values = (given.membrane / stretched_sheets.THICKNESS_M, given.poisson, given.drag)
    return dict(zip(FITTED_PARAMETERS, values, strict=True))


def run_twin(seed: int, refine: bool = False) -> dict:
    """One line of the study; ``refine``: corrected for the mesh."""
    given = draw_fabric(seed)
    recording = stretched_sheets.record_episode(given, seed)
    began = time.process_time()
    model = stretched_sheets.build_start_cloth(recording, youngs_modulus=8e4, poisson_ratio=0.25)
    fit = identify(model, recording, FITTED_PARAMETERS, nuisances={"grasp": 1e-3}, refine=refine)
    line = {"seed": seed, "seconds": time.process_time() - began, "iterations": fit.fit["iterations"]}
    for name, truth in true_values(given).items():
        e = fit.parameters[name]
        line[name] = {"truth": truth, "value": e.value, "std": e.std, "ci95": e.ci95, "identifiable": e.identifiable}
    return line | {"nuisances": {k: [e.value, e.std] for own in fit.nuisances.values() for k, e in own.items()}}


def summarise_twins(lines: list[dict]) -> dict[str, dict[str, float]]:
    """By parameter: twins, share that is called identifiable, of those the share covered, bias and spread."""
    out = {}
    for name in FITTED_PARAMETERS:
        own = [line[name] for line in lines]
        known = [e for e in own if e["identifiable"]]
        z = np.array([_normalised_error(e) for e in known])
        inside = [e["ci95"][0] <= e["truth"] <= e["ci95"][1] for e in known]
        out[name] = {
            "identifiable": len(known) / len(own),
            "covered": float(np.mean(inside)),
            "mean_error": float(z.mean()),
            "spread": float(z.std()),
            "relative_error": float(np.median([abs(e["value"] / e["truth"] - 1) for e in known])),
            "relative_std": float(np.median([e["std"] / e["value"] for e in known])),
        }
    return out


def _normalised_error(e: dict) -> float:
    """Error over its standard deviation; the latter from the interval, in the value's coordinate."""
    low, high = e["ci95"]
    half = (high - e["value"] if e["truth"] > e["value"] else e["value"] - low) / 1.96
    return (e["value"] - e["truth"]) / max(half, 1e-300)


def run_twins(path: Path, twins: int, first: int = 0, refine: bool = False) -> list[dict]:
    """All twins that ``path`` does not hold yet."""
    lines = [json.loads(text) for text in path.read_text().splitlines()] if path.exists() else []
    done = {line["seed"] for line in lines}
    for seed in range(first, first + twins):
        if seed not in done:
            lines.append(run_twin(seed, refine))
            with path.open("a") as file:
                file.write(json.dumps(lines[-1]) + "\n")
            print(f"twin {seed}: {lines[-1]['seconds']:.1f} s", file=sys.stderr, flush=True)
    return lines


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--twins", type=int, default=48)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--refine", action="store_true", help="correct for the mesh (use another OUT.jsonl)")
    options = parser.parse_args()
    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    found = summarise_twins(run_twins(options.out, options.twins, options.first, options.refine))
    for name, row in found.items():
        print(f"{name:16s} " + "  ".join(f"{k} {v:.3f}" for k, v in row.items() if not math.isnan(v)))


if __name__ == "__main__":
    main()
