"""Five fabrics, each stretched ten times: E, ν, k and γ beside the paper's tables, and a press that shows k and γ."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from torchcloth._utils.files import write_text
from torchcloth.materials.presets import find_fabric

from ..resumable import ResumableStudy
from . import fabric_figures, fabric_tables
from .fabric_trials import DENSITIES, FAST, FULL, Scale, others, stretches, truth, values
from .paper_fabrics import COV, FABRICS, SYMBOLS

WITHIN = {"E": 0.02, "ν": 0.05}  # of the truth: what is promised
LABEL = (
    "Synthetic: truth and model obey the same law, as no other engine has all of its parameters; between them differ "
    "mesh, step, first shape and density, and the sensors' errors (Kinect depth, 30 % hidden, forces). The truth is "
    "the paper's means, read as kPa at 1 mm."
)


def add(parser: argparse.ArgumentParser) -> None:
    """Options."""
    parser.add_argument(
        "--fabrics", nargs="+", choices=list(FABRICS), metavar="NAME", help=f"some of {', '.join(FABRICS)}"
    )


def run(options: argparse.Namespace) -> None:
    """Compute what is missing, then print, draw and write fabrics.json."""
    scale = chosen(options)
    cases = ResumableStudy(options.out, scale.settings()).run(stretches(scale) | others(scale))
    result = summary(scale, cases)
    write_text(options.out / "fabrics.json", json.dumps(result, indent=1, allow_nan=False, ensure_ascii=False) + "\n")
    fabric_tables.show(result)
    pictures = fabric_figures.draw(options.out, scale, cases)
    print(f"result:   {options.out / 'fabrics.json'}")
    print("pictures: " + ", ".join(map(str, pictures)))


def chosen(options: argparse.Namespace) -> Scale:
    """The study's size, with the fabrics that were asked for."""
    scale = FAST if options.fast else FULL
    return scale._replace(fabrics=tuple(options.fabrics)) if options.fabrics else scale


def summary(scale: Scale, cases: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """The content of fabrics.json."""
    fabrics = {name: _fabric(name, cases) for name in scale.fabrics}
    return {
        "what": LABEL,
        "trials": len(scale.pulls),
        "presses": scale.presses,
        "assumed_density": {name: DENSITIES[name] for name in scale.fabrics},
        "source": find_fabric(scale.fabrics[0]).source,
        "fabrics": fabrics,
        "marks": _marks(fabrics),
        "seconds": float(np.median([c["seconds"] for key, c in cases.items() if "-pull-" in key])),
    }


def _fabric(name: str, cases: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """By symbol: what stretching says, and what the presses say."""
    out: dict[str, Any] = {}
    for symbol, parameter in (*SYMBOLS.items(), ("c_F", "cone")):
        own, paper = truth(name)[parameter], COV[name].get(symbol)
        out[symbol] = {"truth": own, "paper_cov": None if paper is None else paper / 100}
        if symbol in WITHIN:
            out[symbol]["stretched"] = statistics(values(cases, name, "pull", parameter), own)
            continue
        if symbol != "c_F":
            alone = cases[f"{name}-director"]["parameters"][parameter]
            keys = ("identifiable", "says", "tenth_mm", "experiment")
            out[symbol]["stretched"] = {key: alone[key] for key in keys}
        for kind in ("press", "elsewhere"):
            out[symbol][kind] = statistics(values(cases, name, kind, parameter), own)
    return out


def statistics(estimates: Sequence[Mapping[str, Any]], truth: float) -> dict[str, Any]:
    """Of the trials that know the parameter: grand mean, CoV, relative errors. None unless more than half know it."""
    known = [e for e in estimates if e["identifiable"]]
    out: dict[str, Any] = {"trials": len(estimates), "identifiable": len(known)}
    if 2 * len(known) <= len(estimates):
        return out | dict.fromkeys(("mean", "cov", "error", "worst", "std", "covered"))
    found = np.array([e["value"] for e in known])
    mean = float(found.mean())
    return out | {
        "mean": mean,
        "cov": float(found.std(ddof=1) / mean) if len(found) > 1 else None,
        "error": mean / truth - 1,
        "worst": float(np.abs(found / truth - 1).max()),
        "std": float(np.median([e["std"] / e["value"] for e in known])),
        "covered": int(sum(e["ci95"][0] <= truth <= e["ci95"][1] for e in known)),
    }


def _marks(fabrics: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """By promise, whether each fabric keeps it; None where the parameter is not identifiable."""
    out: dict[str, dict[str, Any]] = {}
    for symbol, share in WITHIN.items():
        out[f"mean {symbol} within {100 * share:g} %"] = {
            name: None if (error := own[symbol]["stretched"]["error"]) is None else abs(error) <= share
            for name, own in fabrics.items()
        }
    for symbol in SYMBOLS:
        kind = "stretched" if symbol in WITHIN else "press"
        out[f"CoV of {symbol} no larger than the paper's"] = {
            name: None if (cov := own[symbol][kind]["cov"]) is None else cov <= own[symbol]["paper_cov"]
            for name, own in fabrics.items()
        }
    return out
