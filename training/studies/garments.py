"""Three garments, ten manipulations each: E, nu, k and gamma from partial clouds, with the paper's table."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from ..resumable import write_result
from .manipulations import joint, manipulation_figures, paper_tables, study_cases
from .manipulations.cases import EXTRA_PARAMETERS, PAPER_PARAMETERS
from .manipulations.console_tables import heading_table, number, percent, show
from .manipulations.measures import sample_spread

MIN_CASES_FOR_COV = 3  # in which a parameter is identifiable
PARAMETER_LABELS = {  # symbol, unit, its size in SI units
    "youngs_modulus": ("E", "[kPa]", 1e3),
    "poisson_ratio": ("nu", "", 1.0),
    "contact_stiffness": ("k", "[kPa]", 1e3),
    "shear_stiffness": ("gamma", "[kPa]", 1e3),
    "bending.stiffness": ("bending", "[uN m]", 1e-6),
    "air.normal": ("air C_n", "", 1.0),
}


def add(parser: argparse.ArgumentParser) -> None:
    """Add the study's options."""
    study_cases.add(parser)
    joint.add(parser)


def run(options: argparse.Namespace) -> None:
    """Compute the missing cases, or joint fits on request; then print tables and write result and figures."""
    if options.joint:
        return joint.run(options)
    cases = study_cases.load_or_compute(options)
    result = {garment: _garment(group) for garment, group in _by_garment(cases).items()}
    show(_table(result), *_notes(cases))
    write_result(options.out / "garments.json", "garments", {"garments": result, "cases": len(cases)})
    manipulation_figures.estimates(cases, options.out / "garments.png")


def _by_garment(cases: dict[str, dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    out: dict[str, list[dict[str, Any]]] = {}
    for case in cases.values():
        out.setdefault(case["manipulation"]["garment"], []).append(case)
    return out


def _garment(group: list[dict[str, Any]]) -> dict[str, Any]:
    """Return for each parameter the truth, mean and CoV where it is identifiable, counts, and the effect of 10 %."""
    out = {}
    for name in (*PAPER_PARAMETERS, *EXTRA_PARAMETERS):
        fits = [case for case in group if "estimates" in case]
        known = [fit["estimates"][name] for fit in fits if fit["estimates"][name]["identifiable"]]
        over = sample_spread([e["value"] for e in known])
        truth = group[0]["truth"][name]
        covered = sum(e["ci95"][0] <= truth <= e["ci95"][1] for e in known)
        out[name] = {
            "truth": truth,
            "mean": over.mean if known else None,
            "cov": over.cov if over.count >= MIN_CASES_FOR_COV else None,
            "identified": over.count,
            "covered": covered,
            "of": len(group),
            "values": [e["value"] for e in known],
            "moves_mm": float(np.median([fit["moves_mm"][name] for fit in fits])) if fits else None,
        }
    return out


def _table(result: dict[str, dict[str, Any]]):
    table = heading_table(
        "Parameters of garments: mean of the manipulations that identify them | the paper's", "garment", "parameter",
        "truth", "mean", "error", "CoV", "cases", "in 95 %", "10 % moves [mm]", "| paper", "CoV",
    )  # fmt: skip
    for garment, rows in result.items():
        for name, r in rows.items():
            symbol, unit, scale = PARAMETER_LABELS[name]
            mean, cov = paper_tables.PARAMETERS.get(name, {}).get(garment, (None, None))
            known = r["mean"] is not None
            table.add_row(
                garment,
                f"{symbol} {unit}",
                number(r["truth"] / scale),
                number(r["mean"] / scale) if known else "not identifiable",
                f"{100 * (r['mean'] / r['truth'] - 1):+.0f} %" if known else "",
                percent(r["cov"]) if known else "",
                f"{r['identified']} of {r['of']}",
                f"{r['covered']} of {r['identified']}" if r["identified"] else "",
                number(r["moves_mm"]) if r["moves_mm"] is None or r["moves_mm"] >= 1e-3 else "none",
                "" if mean is None else number(mean),
                "" if cov is None else f"{cov:.1f} %",
                end_section=name == EXTRA_PARAMETERS[-1],
            )
    return table


def _notes(cases: dict[str, dict[str, Any]]) -> list[str]:
    """Return notes on the table."""
    fits = [case for case in cases.values() if "estimates" in case]
    unstable = sum(any("unstable" in w for w in fit["warnings"]) for fit in fits)
    poor = sum(any("no better than" in w for w in fit["warnings"]) for fit in fits)
    none = sum(not any(fit["estimates"][name]["identifiable"] for name in PAPER_PARAMETERS) for fit in fits)
    hidden = sample_spread([case["hidden"] for case in cases.values()]).mean
    return [
        "Truth: the same engine and law on another mesh, contact grid and step, with Kinect noise. A pole hides "
        f"{100 * hidden:.0f} % of the cloth that the camera would see. True E and nu are the paper's, read as kPa at "
        "1 mm; true k and gamma are those of `torchcloth simulate`. Bending and air drag are fitted, too. The early "
        "frames are fitted (half of them, or --share), because later ones are folded and in contact.",
        f"{len(cases)} cases, {len(cases) - len(fits)} failed. {none} identify none of the four: in {unstable} the "
        f"motion is too unstable for its slopes, {poor} are no better than the rigid-carry null. Parameters that are "
        "not identifiable have no value and enter no mean. Layers of a garment that are near along the cloth, e.g. "
        "front and back, do not touch on such coarse meshes.",
    ]
