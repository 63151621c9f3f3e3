"""Three garments, ten manipulations each: E, nu, k and gamma from partial clouds, beside the paper's table."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from .manipulations import joint, manipulation_figures, paper_tables, study_cases
from .manipulations.cases import FREE, SOUGHT
from .manipulations.console_tables import heading_table, number, percent, show, write
from .manipulations.measures import spread

LEAST = 3  # cases that identify a parameter before their scatter is given
SHOWN = {  # symbol, unit, SI units in one of these
    "youngs_modulus": ("E", "[kPa]", 1e3),
    "poisson_ratio": ("nu", "", 1.0),
    "contact_stiffness": ("k", "[kPa]", 1e3),
    "shear_stiffness": ("gamma", "[kPa]", 1e3),
    "bending.stiffness": ("bending", "[uN m]", 1e-6),
    "air.normal": ("air C_n", "", 1.0),
}


def add(parser: argparse.ArgumentParser) -> None:
    """Options."""
    study_cases.add(parser)
    joint.add(parser)


def run(chosen: argparse.Namespace) -> None:
    """All cases, or what is done instead; then tables, result and pictures."""
    if chosen.joint:
        return joint.run(chosen)
    found = study_cases.cases(chosen)
    result = {garment: _garment(own) for garment, own in _by_garment(found).items()}
    show(_table(result), *_notes(found))
    write(chosen.out / "garments.json", {"garments": result, "cases": len(found)})
    manipulation_figures.estimates(found, chosen.out / "garments.png")


def _by_garment(found: dict[str, dict[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    out: dict[str, list[dict[str, Any]]] = {}
    for case in found.values():
        out.setdefault(case["manipulation"]["garment"], []).append(case)
    return out


def _garment(own: list[dict[str, Any]]) -> dict[str, Any]:
    """Parameter -> truth, mean and CoV of the cases that identify it, how many, and how far 10 % moves (median)."""
    out = {}
    for name in (*SOUGHT, *FREE):
        fits = [case for case in own if "found" in case]
        known = [fit["found"][name] for fit in fits if fit["found"][name]["identifiable"]]
        over = spread([e["value"] for e in known])
        truth = own[0]["truth"][name]
        covered = sum(e["ci95"][0] <= truth <= e["ci95"][1] for e in known)
        out[name] = {
            "truth": truth,
            "mean": over.mean if known else None,
            "cov": over.cov if over.count >= LEAST else None,
            "identified": over.count,
            "covered": covered,
            "of": len(own),
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
            symbol, unit, scale = SHOWN[name]
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
                end_section=name == FREE[-1],
            )
    return table


def _notes(found: dict[str, dict[str, Any]]) -> list[str]:
    """What the table does not say."""
    fits = [case for case in found.values() if "found" in case]
    unstable = sum(any("unstable" in w for w in fit["warnings"]) for fit in fits)
    poor = sum(any("no better than" in w for w in fit["warnings"]) for fit in fits)
    none = sum(not any(fit["found"][name]["identifiable"] for name in SOUGHT) for fit in fits)
    hidden = spread([case["hidden"] for case in found.values()]).mean
    return [
        "Truth: the fitted engine on another mesh, contact grid and step (same law); Kinect noise; a pole hides "
        f"{100 * hidden:.0f} % of the cloth that the camera would see. E and nu of the truth are the paper's, read as "
        "kPa at 1 mm; k and gamma are those of `torchcloth simulate`. Free beside the four: bending and air drag. "
        "Fitted are the early frames (half of them, unless --share says otherwise): later ones are folded and touch.",
        f"{len(found)} cases, {len(found) - len(fits)} failed; {none} identify none of the four: in {unstable} the "
        f"motion is too unstable for its slopes, {poor} do not beat the rigid-carry null. What is not identified is no "
        "number and in no mean.",
    ]
