"""What an ablation study shows: distances and shares of energy, and how they agree with the paper."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import torch

from torchcloth._utils.files import write_text
from torchcloth.errors import InvalidInput

from .measures import bidirectional_chamfer, contributions, spearman
from .paper_tables import CHAMFER, ENERGY
from .runs import Name, Study
from .scenes import LEVELS, PARAMETERS, PERTURBED, REFERENCE, Run, Variant

CONVENTION = (
    "chamfer_cm: bidirectional Chamfer distance [cm] to the reference run, the sum of both means of the distance from "
    "each vertex to the other run's nearest vertex, of the final shapes; chamfer_mean_cm: the same, mean over the "
    "motion's frames. Distances are lengths of the scaled scene. energy: C = (W - W_j) / W, W the mean over the frames "
    "of the membrane's and the directors' energy in the reference run, W_j the same states' energy with that "
    "parameter's terms left out: E the whole membrane, nu lambda/2 (J - 1)^2, k and gamma theirs of the director; "
    "'nu = 0': Poisson's ratio 0 in mu as well. perturbed: the start moved by 1 um. corotated: k = gamma = 0. Actions: "
    "means over the garments. The paper states no unit of its distances, here read as cm."
)

CHAOS = 3.0  # a distance below that many times what a start moved by 1 um changes says nothing


def measure(study: Study, scenes: Sequence[Name], wanted: Sequence[Variant]) -> dict[Name, dict[str, Any]]:
    """Distances and shares of each scene, from the runs that are finished; scenes without reference are left out."""
    found = {}
    for scene in scenes:
        if not study.has(scene, REFERENCE):
            continue
        reference = study.read(scene, REFERENCE)
        final, mean = {}, {}
        for variant in wanted:
            if variant != REFERENCE and study.has(scene, variant):
                final[variant], mean[variant] = _distances(study.read(scene, variant), reference)
        found[scene] = {"final": final, "mean": mean, "energy": contributions(reference.energy)}
    return found


def _distances(run: Run, reference: Run) -> tuple[float, float]:
    pairs = zip(*(torch.as_tensor(x, dtype=torch.float64) for x in (run.x, reference.x)), strict=True)
    distance = [bidirectional_chamfer(a, b) for a, b in pairs]
    return 100 * distance[-1], 100 * float(np.mean(distance))


def averaged(measured: dict[Name, dict[str, Any]], key: str) -> dict[str, dict[Any, float]]:
    """Mean over the garments of each action, of the entries that all of them have."""
    out: dict[str, dict[Any, float]] = {}
    for action in dict.fromkeys(action for _, action in measured):
        rows = [m[key] for (_, own), m in measured.items() if own == action]
        common = [entry for entry in rows[0] if all(entry in row for row in rows)]
        out[action] = {entry: float(np.mean([row[entry] for row in rows])) for entry in common}
    return out


def agreement(distance: dict[str, dict[Variant, float]], energy: dict[str, dict[str, float]]) -> dict[str, Any]:
    """Spearman's rank correlation with the paper's numbers: of each table, per action and over all."""
    ours, paper = {}, {}
    for action, row in distance.items():
        cells = [variant for variant in row if variant.parameter in PARAMETERS]
        ours[action] = [row[v] for v in cells]
        paper[action] = [CHAMFER[action][v.parameter][LEVELS.index(v.level)] for v in cells]
    out: dict[str, Any] = {"chamfer": {a: spearman(ours[a], paper[a]) for a in ours if len(ours[a]) > 1}}
    everything = [[d for row in table.values() for d in row] for table in (ours, paper)]
    if len(everything[0]) > 1:
        out["chamfer"]["all"] = spearman(*everything)
    out["energy"] = {a: spearman([row[p] for p in PARAMETERS], list(ENERGY[a].values())) for a, row in energy.items()}
    out["order"] = {
        action: {"ours": _order(row), "paper": _paper_order(action, row)} for action, row in distance.items()
    }
    cells = {action: [d for v, d in row.items() if v.parameter in PARAMETERS] for action, row in distance.items()}
    noise = {action: CHAOS * row[PERTURBED] for action, row in distance.items() if PERTURBED in row}
    out["beyond_chaos"] = {a: [sum(d >= least for d in cells[a]), len(cells[a])] for a, least in noise.items()}
    return out


def _order(row: dict[Variant, float]) -> list[str]:
    """Parameters by their mean distance, the strongest first."""
    mean = {p: np.mean([d for v, d in row.items() if v.parameter == p] or [0.0]) for p in PARAMETERS}
    return sorted(mean, key=lambda p: -mean[p])


def _paper_order(action: str, row: dict[Variant, float]) -> list[str]:
    cells = {v: CHAMFER[action][v.parameter][LEVELS.index(v.level)] for v in row if v.parameter in PARAMETERS}
    return _order(cells)


def report(study: Study, scenes: Sequence[Name], wanted: Sequence[Variant]) -> None:
    """Print the tables and write result.json and the pictures.

    Raises:
        InvalidInput: no scene has its reference run yet.
    """
    from .ablation_figures import draw
    from .ablation_tables import print_study

    measured = measure(study, scenes, wanted)
    if not measured:
        raise InvalidInput("--out", got=f"no finished reference run in {study.folder}", expected="a study to report on")
    distance, energy = averaged(measured, "final"), averaged(measured, "energy")
    result = {
        "convention": CONVENTION,
        "setup": asdict(study.setup),
        "runs": {"finished": sum(study.has(s, v) for s in scenes for v in wanted), "of": len(scenes) * len(wanted)},
        "scenes": {" ".join(scene): _plain(m) for scene, m in measured.items()},
        "actions": {action: {"chamfer_cm": _named(distance[action]), "energy": energy[action]} for action in distance},
        "paper": {"chamfer": CHAMFER, "energy_percent": ENERGY, "levels": LEVELS},
        "agreement": agreement(distance, energy)
        | {"chamfer_mean": agreement(averaged(measured, "mean"), energy)["chamfer"]},
    }
    text = json.dumps(result, indent=1).replace("NaN", "null") + "\n"
    write_text(study.folder / "result.json", text)
    pictures = draw(study, list(measured), distance, energy)
    print_study(result, distance, energy, measured)
    print(f"result:   {study.folder / 'result.json'}")
    print("pictures: " + ", ".join(map(str, pictures)))


def _plain(m: dict[str, Any]) -> dict[str, Any]:
    return {"chamfer_cm": _named(m["final"]), "chamfer_mean_cm": _named(m["mean"]), "energy": m["energy"]}


def _named(row: dict[Variant, float]) -> dict[str, float]:
    return {variant.name: value for variant, value in row.items()}
