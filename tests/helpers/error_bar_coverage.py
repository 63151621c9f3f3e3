"""Coverage of the 95 % intervals: seeded twins with another mesh, grid, step and other values than the model.

    PYTHONPATH=tests python -m helpers.error_bar_coverage OUT.jsonl [--twins 48] [--first 0] [--refine]

Each twin adds one line, and a stopped run resumes. The table is printed at the end.
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
from helpers.twins import SAME_SIMULATOR
from torchcloth._utils.constants import Z_95
from torchcloth.identification import identify

FITTED_PARAMETERS = ("youngs_modulus", "poisson_ratio", "air.normal")


def draw_fabric(seed: int) -> stretched_sheets.Fabric:
    """Return a fabric drawn around the default."""
    rng = np.random.default_rng(10_000 + seed)
    return stretched_sheets.Fabric(
        membrane=60.0 * 1.5 ** rng.uniform(-1, 1), poisson=rng.uniform(0.2, 0.4), drag=rng.uniform(0.8, 1.6)
    )


def true_values(given: stretched_sheets.Fabric) -> dict[str, float]:
    """Return the true values by parameter name."""
    values = (given.membrane / stretched_sheets.THICKNESS_M, given.poisson, given.drag)
    return dict(zip(FITTED_PARAMETERS, values, strict=True))


def run_twin(seed: int, refine: bool = False) -> dict:
    """Return one line of the study; ``refine``: corrected for the mesh."""
    given = draw_fabric(seed)
    recording = stretched_sheets.record_episode(given, seed)
    began = time.process_time()
    model = stretched_sheets.build_start_cloth(recording, youngs_modulus=8e4, poisson_ratio=0.25)
    fit = identify(
        model,
        recording,
        FITTED_PARAMETERS,
        nuisances={"grasp": 1e-3},
        refine=refine,
        model_errors=SAME_SIMULATOR,
        exact_bench=True,
    )
    line = {"seed": seed, "seconds": time.process_time() - began, "iterations": fit.fit["iterations"]}
    for name, truth in true_values(given).items():
        e = fit.parameters[name]
        line[name] = {"truth": truth, "value": e.value, "std": e.std, "ci95": e.ci95, "identifiable": e.identifiable}
    return line | {
        "nuisances": {k: [e.value, e.std] for estimates in fit.nuisances.values() for k, e in estimates.items()}
    }


def summarise_twins(lines: list[dict]) -> dict[str, dict[str, float]]:
    """Return by parameter: the identifiable fraction, the covered fraction of these, bias and spread."""
    out = {}
    for name in FITTED_PARAMETERS:
        estimates = [line[name] for line in lines]
        identified = [e for e in estimates if e["identifiable"]]
        z = np.array([_normalised_error(e) for e in identified])
        inside = [e["ci95"][0] <= e["truth"] <= e["ci95"][1] for e in identified]
        out[name] = {
            "identifiable": len(identified) / len(estimates),
            "covered": float(np.mean(inside)),
            "mean_error": float(z.mean()),
            "spread": float(z.std()),
            "relative_error": float(np.median([abs(e["value"] / e["truth"] - 1) for e in identified])),
            "relative_std": float(np.median([e["std"] / e["value"] for e in identified])),
        }
    return out


def _normalised_error(e: dict) -> float:
    """Return the error over its standard deviation, which follows from the interval on the error's side."""
    low, high = e["ci95"]
    half = (high - e["value"] if e["truth"] > e["value"] else e["value"] - low) / Z_95
    return (e["value"] - e["truth"]) / max(half, 1e-300)


def run_twins(path: Path, twins: int, first: int = 0, refine: bool = False) -> list[dict]:
    """Run all twins that ``path`` does not contain, and return all lines."""
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
    """Fit all twins and print how often the intervals hold the truth."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--twins", type=int, default=48)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--refine", action="store_true", help="correct for the mesh (use another OUT.jsonl)")
    options = parser.parse_args()
    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    table = summarise_twins(run_twins(options.out, options.twins, options.first, options.refine))
    for name, row in table.items():
        print(f"{name:16s} " + "  ".join(f"{k} {v:.3f}" for k, v in row.items() if not math.isnan(v)))


if __name__ == "__main__":
    main()
