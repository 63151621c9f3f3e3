"""Five fabrics, each stretched ten times: E, ν, k and γ with the paper's tables, and presses for k and γ."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from torchcloth.materials.presets import find_fabric

from ..resumable import ResumableStudy, write_result
from . import fabric_figures, fabric_tables
from .fabric_trials import (
    ASSUMED_DENSITY_KG_PER_M2,
    FAST_SCALE,
    FULL_SCALE,
    Scale,
    estimates_of,
    other_cases,
    stretch_cases,
    true_values,
)
from .paper_fabrics import COV, FABRICS, SYMBOLS

PROMISED_ERROR = {"E": 0.02, "ν": 0.05}  # relative to the truth
STUDY_TEXT = (
    "Synthetic: truth and model obey the same law, because no other engine has all of its parameters. They differ in "
    "mesh, step, first shape and density. The data have the errors of sensors (Kinect depth, 30 % hidden, forces). "
    "True values are the paper's means, read as kPa at 1 mm."
)


def add(parser: argparse.ArgumentParser) -> None:
    """Add the study's options."""
    parser.add_argument(
        "--fabrics", nargs="+", choices=list(FABRICS), metavar="NAME", help=f"one or more of {', '.join(FABRICS)}"
    )


def run(options: argparse.Namespace) -> None:
    """Compute the missing cases, then print, draw and write fabrics.json."""
    scale = choose_scale(options)
    cases = ResumableStudy(options.out, scale.settings()).run(stretch_cases(scale) | other_cases(scale))
    result = summarise(scale, cases)
    write_result(options.out / "fabrics.json", "fabrics", result)
    fabric_tables.show(result)
    pictures = fabric_figures.draw(options.out, scale, cases)
    print(f"result:   {options.out / 'fabrics.json'}")
    print("pictures: " + ", ".join(map(str, pictures)))


def choose_scale(options: argparse.Namespace) -> Scale:
    """Return the study's size with the selected fabrics."""
    scale = FAST_SCALE if options.fast else FULL_SCALE
    return scale._replace(fabrics=tuple(options.fabrics)) if options.fabrics else scale


def summarise(scale: Scale, cases: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the content of fabrics.json."""
    fabrics = {name: _fabric(name, cases) for name in scale.fabrics}
    return {
        "what": STUDY_TEXT,
        "trials": len(scale.pulls),
        "presses": scale.presses,
        "assumed_density": {name: ASSUMED_DENSITY_KG_PER_M2[name] for name in scale.fabrics},
        "source": find_fabric(scale.fabrics[0]).source,
        "fabrics": fabrics,
        "marks": _marks(fabrics),
        "seconds": float(np.median([c["seconds"] for key, c in cases.items() if "-pull-" in key])),
    }


def _fabric(name: str, cases: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return by symbol the statistics of stretching trials and presses."""
    out: dict[str, Any] = {}
    for symbol, parameter in (*SYMBOLS.items(), ("c_F", "cone")):
        true_value, paper = true_values(name)[parameter], COV[name].get(symbol)
        out[symbol] = {"truth": true_value, "paper_cov": None if paper is None else paper / 100}
        if symbol in PROMISED_ERROR:
            out[symbol]["stretched"] = statistics(estimates_of(cases, name, "pull", parameter), true_value)
            continue
        if symbol != "c_F":
            alone = cases[f"{name}-director"]["parameters"][parameter]
            keys = ("identifiable", "statement", "tenth_mm", "experiment")
            out[symbol]["stretched"] = {key: alone[key] for key in keys}
        for kind in ("press", "elsewhere"):
            out[symbol][kind] = statistics(estimates_of(cases, name, kind, parameter), true_value)
    return out


def statistics(estimates: Sequence[Mapping[str, Any]], true_values: float) -> dict[str, Any]:
    """Return grand mean, CoV and relative errors of the trials in which the parameter is identifiable.

    The values are None unless it is identifiable in more than half of the trials.
    """
    known = [e for e in estimates if e["identifiable"]]
    out: dict[str, Any] = {"trials": len(estimates), "identifiable": len(known)}
    if 2 * len(known) <= len(estimates):
        return out | dict.fromkeys(("mean", "cov", "error", "worst", "std", "covered"))
    sample = np.array([e["value"] for e in known])
    mean = float(sample.mean())
    return out | {
        "mean": mean,
        "cov": float(sample.std(ddof=1) / mean) if len(sample) > 1 else None,
        "error": mean / true_values - 1,
        "worst": float(np.abs(sample / true_values - 1).max()),
        "std": float(np.median([e["std"] / e["value"] for e in known])),
        "covered": int(sum(e["ci95"][0] <= true_values <= e["ci95"][1] for e in known)),
    }


def _marks(fabrics: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return for each promise whether each fabric meets it; None if the parameter is not identifiable."""
    out: dict[str, dict[str, Any]] = {}
    for symbol, share in PROMISED_ERROR.items():
        out[f"mean {symbol} within {100 * share:g} %"] = {
            name: None if (error := entry[symbol]["stretched"]["error"]) is None else abs(error) <= share
            for name, entry in fabrics.items()
        }
    for symbol in SYMBOLS:
        kind = "stretched" if symbol in PROMISED_ERROR else "press"
        out[f"CoV of {symbol} no larger than the paper's"] = {
            name: None if (cov := entry[symbol][kind]["cov"]) is None else cov <= entry[symbol]["paper_cov"]
            for name, entry in fabrics.items()
        }
    return out
