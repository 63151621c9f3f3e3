"""Diagnoses a development case again: what was simulated before is kept, so that other decisions cost seconds.

python -m torchcloth.training.validation.hidden.rerun_case --seed 66 --keep cases     # makes cases/66 once, then says what was tried and why

For one process a case. A change in what is simulated (a mesh, a parameter, the catalogue) needs a new folder.
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
from torchcloth._utils import resume as kept
from torchcloth.diagnosis.decide import candidates
from torchcloth.diagnosis.decide.candidates import Candidate
from torchcloth.diagnosis.inference.comparison import spread

from . import make_case
from .case_sampling import DEVELOPMENT, REDUCED, SMALL, case
from .effect_map import NUMBERS

KEYS = ("effect", "amplitude", "ci95", "noise_ci95", "told_by", "motions_disagree", "class", "rivals", "placebo")


def said(c: Candidate, names: list[str]) -> str:
    """One line on a cause that was tried."""
    place = c.fitted.model.place(c.hypothesis.name)
    middle, motions = (float(v[len(c.fitted.model.parameters) + place]) for v in spread(c.fitted, names, c.alone))
    (calm, after), (seen, felt), (low, high) = c.gain.calm, c.gain.mended, c.gain.ci95
    whole = f"{1e3 * c.gain.before:.3f} -> {1e3 * c.gain.after:.3f} mm"
    return (
        f"  {c.hypothesis.name:22} {c.amplitude:9.3g} {c.hypothesis.unit:8} density {c.gain.density:8.1f} "
        f"({low:.0f} to {high:.0f}), {whole}, calm {1e3 * calm:.2f} -> {1e3 * after:.2f} mm, mended "
        f"{1e3 * seen:.2f} mm or {1e3 * felt:.1f} mN, {abs(middle) / max(motions, 1e-30):.1f} standard "
        f"errors between motions ({c.sure:.2f} asked), chi^2 {float(c.fitted.white.value.square().sum()):.0f}"
    )


def main(arguments: list[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--keep", type=Path, required=True, metavar="DIR")
    parser.add_argument("--fast", action="store_true", help="fewer and shorter episodes, coarser meshes")
    parser.add_argument("--nodes", type=int, help="vertices along the truth's sides, of which all cases have the same")
    options = parser.parse_args(arguments)
    if not 0 <= options.seed < DEVELOPMENT:
        print(f"--seed: got {options.seed}; expected 0 to {DEVELOPMENT - 1}: others are sealed", file=sys.stderr)
        return 2
    torch.set_default_dtype(torch.float64)
    folder = options.keep / str(options.seed)
    how = ["--fast"] * options.fast + ([] if options.nodes is None else ["--nodes", str(options.nodes)])
    if not folder.exists() and make_case.main(["--seed", str(options.seed), "--out", str(folder / "episodes"), *how]):
        return 2
    episodes = [recordings.read(path) for path in sorted((folder / "episodes").iterdir())]
    journal = folder / "journal"
    usual = candidates._compared

    def compared(current, fits, names, *how):
        found = usual(current, fits, names, *how)
        print("tried:", *(said(c, names) for c in found), sep="\n", flush=True)
        return found

    candidates._compared = compared
    kept.source_fingerprint = lambda: "whatever decides"  # else every change of the library would begin anew
    answer = diagnosis.diagnose(episodes, journal=journal, resume=journal.exists())
    model, std = answer.model, answer.found.end.covariance.diagonal().sqrt()
    for p, c, s in zip(model.parameters, model.values.tolist(), std.tolist(), strict=False):
        pull = abs(c) / max(p.std**2 - s**2, 1e-12) ** 0.5
        print(f"fitted: {p.name:22} {c:+.3f} +- {s:.3f}, prior {p.std:.3f}, pulled by {pull:.1f}")
    for row in sorted(answer.found.screened, key=lambda r: -r.worth)[:8]:
        print(f"left: {row.hypothesis.name:22} {row.amplitude:9.3g} +- {row.std:.2g}  {row.decision}")
    for row in answer.content["lack_of_fit"]:
        if row["lacking"]:
            print(f"lacking: {row['motion']} {row['kind']} {row['ratio']:.2f}")
    print(answer.verdict, "and something else" * answer.content["also_unexplained"])
    for cause in answer.content["causes"]:
        print(
            "named:",
            json.dumps({key: cause[key] for key in KEYS}),
        )
    if (gain := answer.content["gain"]) is not None:
        print(f"gain: {1e3 * gain['rms_before']:.3f} -> {1e3 * gain['rms_after']:.3f} mm on motions held out")
    hidden = case(options.seed, SMALL if options.fast else REDUCED)
    for name, sheet in NUMBERS.items():
        print(f"true:   {name:22} {-math.log(hidden.said[sheet]):+.3f}")
    print("hidden:", json.dumps([asdict(e) for e in hidden.effects]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
