"""Diagnose a development case again, with the stored simulations of the last time: other decisions cost seconds.

    python -m torchcloth.training.validation.hidden.rerun_case --seed 66 --folder cases

It makes cases/66 once, then prints the candidates and their statistics. Only one process may work on a case. A change
of what is simulated (a mesh, a parameter, the catalogue) needs a new folder.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from dataclasses import asdict
from pathlib import Path

import torch

from torchcloth import diagnosis, recordings
from torchcloth._utils import resume
from torchcloth.diagnosis.decide import candidates
from torchcloth.diagnosis.decide.gates import Candidate
from torchcloth.diagnosis.inference.comparison import jackknife

from . import make_case
from .case_sampling import DEVELOPMENT_SEEDS, FAST_SIZE, ROUND_SIZE, draw_case
from .effect_map import FITTED_FABRIC_VALUES

PRINTED_CAUSE_KEYS = (
    "effect",
    "amplitude",
    "ci95",
    "noise_ci95",
    "effective_motions",
    "motions_disagree",
    "equivalence_class",
    "rivals",
    "permutation_test",
)


def describe_candidate(c: Candidate, names: list[str]) -> str:
    """Return one line on a candidate."""
    index = c.fit.model.index_of(c.hypothesis.name)
    mean, motions_std = (
        float(v[len(c.fit.model.parameters) + index]) for v in jackknife(c.fit, names, c.sole_informative_motion)
    )
    (robust_before, robust_after), (removed_m, removed_n) = c.gain.robust_rms, c.gain.rms_removed
    low, high = c.gain.log_density_ci95
    chi_squared = float(c.fit.whitened.value.square().sum())
    rms = f"{1e3 * c.gain.rms_before:.3f} -> {1e3 * c.gain.rms_after:.3f} mm"
    return (
        f"  {c.hypothesis.name:22} {c.amplitude:9.3g} {c.hypothesis.unit:8} density {c.gain.log_density:8.1f} "
        f"({low:.0f} to {high:.0f}), {rms}, robust RMS {1e3 * robust_before:.2f} -> {1e3 * robust_after:.2f} mm, "
        f"removed {1e3 * removed_m:.2f} mm or {1e3 * removed_n:.1f} mN, t between motions "
        f"{abs(mean) / max(motions_std, 1e-30):.1f} (threshold {c.t_threshold:.2f}), chi^2 {chi_squared:.0f}"
    )


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--folder", type=Path, required=True, metavar="DIR")
    parser.add_argument("--fast", action="store_true", help="fewer and shorter episodes, coarser meshes")
    parser.add_argument("--nodes", type=int, help="vertices along the truth's sides (default: as in all cases)")
    options = parser.parse_args(arguments)
    if not 0 <= options.seed < DEVELOPMENT_SEEDS:
        print(f"--seed: got {options.seed}; expected 0 to {DEVELOPMENT_SEEDS - 1}: others are sealed", file=sys.stderr)
        return 2
    torch.set_default_dtype(torch.float64)
    folder = options.folder / str(options.seed)
    size = ["--fast"] * options.fast + ([] if options.nodes is None else ["--nodes", str(options.nodes)])
    if not folder.exists() and make_case.main(["--seed", str(options.seed), "--out", str(folder / "episodes"), *size]):
        return 2
    episodes = [recordings.read(path) for path in sorted((folder / "episodes").iterdir())]
    journal = folder / "journal"
    compare = candidates._compare_held_out

    def compare_and_print(current, fits, names, *options):
        compared = compare(current, fits, names, *options)
        print("candidates:", *(describe_candidate(c, names) for c in compared), sep="\n", flush=True)
        return compared

    candidates._compare_held_out = compare_and_print
    resume.source_fingerprint = lambda: (
        "any"
    )  # else every change of the library would invalidate the stored simulations
    answer = diagnosis.diagnose(episodes, journal=journal, resume=journal.exists(), checks=False)
    model, std = answer.model, answer.search.end.covariance.diagonal().sqrt()
    for p, c, s in zip(model.parameters, model.coordinates.tolist(), std.tolist(), strict=False):
        pull = abs(c) / max(p.prior_std**2 - s**2, 1e-12) ** 0.5
        print(f"fitted: {p.name:22} {c:+.3f} +- {s:.3f}, prior {p.prior_std:.3f}, pull {pull:.1f}")
    for row in sorted(answer.search.scores, key=lambda r: -r.expected_gain)[:8]:
        print(f"score: {row.hypothesis.name:22} {row.amplitude:9.3g} +- {row.std:.2g}  {row.decision}")
    for row in answer.content["lack_of_fit"]:
        if row["is_significant"]:
            print(f"lack of fit: {row['motion']} {row['kind']} {row['rms_ratio']:.2f}")
    print(answer.verdict, "and something unexplained" * answer.content["also_unexplained"])
    for cause in answer.content["causes"]:
        print("named:", json.dumps({key: cause[key] for key in PRINTED_CAUSE_KEYS}))
    if (gain := answer.content["gain"]) is not None:
        print(f"gain: {1e3 * gain['rms_before']:.3f} -> {1e3 * gain['rms_after']:.3f} mm on held-out motions")
    hidden = draw_case(options.seed, FAST_SIZE if options.fast else ROUND_SIZE)
    for name, fabric_name in FITTED_FABRIC_VALUES.items():
        print(f"true:   {name:22} {-math.log(hidden.data_sheet_ratio[fabric_name]):+.3f}")
    print("hidden:", json.dumps([asdict(e) for e in hidden.effects]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
