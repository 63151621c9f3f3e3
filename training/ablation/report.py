"""Report of an ablation: distances, energy contributions, and their agreement with the paper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import torch

from torchcloth.errors import InvalidInput

from ..resumable import write_result
from .ablation_figures import draw
from .ablation_tables import print_study
from .measures import CHAOS_FACTOR, bidirectional_chamfer, energy_contributions, rank_correlation
from .paper_tables import CHAMFER, ENERGY
from .runs import AblationStudy, SceneName
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


def measure(
    study: AblationStudy, scenes: Sequence[SceneName], variants: Sequence[Variant]
) -> dict[SceneName, dict[str, Any]]:
    """Measure distances and energy contributions of each scene from its finished runs.

    Scenes without a finished reference run are left out.
    """
    measured = {}
    for scene in scenes:
        if not study.has_run(scene, REFERENCE):
            continue
        reference = study.load_run(scene, REFERENCE)
        final, mean = {}, {}
        for variant in variants:
            if variant != REFERENCE and study.has_run(scene, variant):
                final[variant], mean[variant] = _distances(study.load_run(scene, variant), reference)
        measured[scene] = {"final": final, "mean": mean, "energy": energy_contributions(reference.energy)}
    return measured


def _distances(run: Run, reference: Run) -> tuple[float, float]:
    pairs = zip(*(torch.as_tensor(x, dtype=torch.float64) for x in (run.x, reference.x)), strict=True)
    distance = [bidirectional_chamfer(a, b) for a, b in pairs]
    return 100 * distance[-1], 100 * float(np.mean(distance))


def average_over_garments(measured: dict[SceneName, dict[str, Any]], key: str) -> dict[str, dict[Any, float]]:
    """Return the mean over the garments of each action, for entries that all garments have."""
    out: dict[str, dict[Any, float]] = {}
    for action in dict.fromkeys(action for _, action in measured):
        rows = [entry[key] for (_, other), entry in measured.items() if other == action]
        common = [entry for entry in rows[0] if all(entry in row for row in rows)]
        out[action] = {entry: float(np.mean([row[entry] for row in rows])) for entry in common}
    return out


def compare_with_paper(
    distance: dict[str, dict[Variant, float]], energy: dict[str, dict[str, float]]
) -> dict[str, Any]:
    """Return Spearman's rank correlation with the paper's tables, for each action and over all actions."""
    ours, paper = {}, {}
    for action, row in distance.items():
        cells = [variant for variant in row if variant.parameter in PARAMETERS]
        ours[action] = [row[v] for v in cells]
        paper[action] = [CHAMFER[action][v.parameter][LEVELS.index(v.level)] for v in cells]
    out: dict[str, Any] = {"chamfer": {a: rank_correlation(ours[a], paper[a]) for a in ours if len(ours[a]) > 1}}
    everything = [[d for row in table.values() for d in row] for table in (ours, paper)]
    if len(everything[0]) > 1:
        out["chamfer"]["all"] = rank_correlation(*everything)
    out["energy"] = {
        a: rank_correlation([row[p] for p in PARAMETERS], list(ENERGY[a].values())) for a, row in energy.items()
    }
    out["order"] = {
        action: {"ours": _order(row), "paper": _paper_order(action, row)} for action, row in distance.items()
    }
    cells = {action: [d for v, d in row.items() if v.parameter in PARAMETERS] for action, row in distance.items()}
    thresholds = {action: CHAOS_FACTOR * row[PERTURBED] for action, row in distance.items() if PERTURBED in row}
    out["beyond_chaos"] = {
        a: [sum(d >= threshold for d in cells[a]), len(cells[a])] for a, threshold in thresholds.items()
    }
    return out


def _order(row: dict[Variant, float]) -> list[str]:
    """Return the parameters by decreasing mean distance."""
    mean = {p: np.mean([d for v, d in row.items() if v.parameter == p] or [0.0]) for p in PARAMETERS}
    return sorted(mean, key=lambda p: -mean[p])


def _paper_order(action: str, row: dict[Variant, float]) -> list[str]:
    cells = {v: CHAMFER[action][v.parameter][LEVELS.index(v.level)] for v in row if v.parameter in PARAMETERS}
    return _order(cells)


def report(study: AblationStudy, scenes: Sequence[SceneName], variants: Sequence[Variant]) -> None:
    """Print the tables and write result.json and the pictures.

    Raises:
        InvalidInput: no reference run is finished.
    """

    measured = measure(study, scenes, variants)
    if not measured:
        raise InvalidInput("--out", got=f"no finished reference run in {study.folder}", expected="a study to report on")
    distance, energy = average_over_garments(measured, "final"), average_over_garments(measured, "energy")
    result = {
        "convention": CONVENTION,
        "setup": asdict(study.setup),
        "runs": {
            "finished": sum(study.has_run(s, v) for s in scenes for v in variants),
            "of": len(scenes) * len(variants),
        },
        "scenes": {" ".join(scene): _scene_entry(entry) for scene, entry in measured.items()},
        "actions": {
            action: {"chamfer_cm": _by_name(distance[action]), "energy": energy[action]} for action in distance
        },
        "paper": {"chamfer": CHAMFER, "energy_percent": ENERGY, "levels": LEVELS},
        "agreement": compare_with_paper(distance, energy)
        | {"chamfer_mean": compare_with_paper(average_over_garments(measured, "mean"), energy)["chamfer"]},
    }
    write_result(study.folder / "result.json", "ablation", result)
    pictures = draw(study, list(measured), distance, energy)
    print_study(result, distance, energy, measured)
    print(f"result:   {study.folder / 'result.json'}")
    print("pictures: " + ", ".join(map(str, pictures)))


def _scene_entry(entry: dict[str, Any]) -> dict[str, Any]:
    return {
        "chamfer_cm": _by_name(entry["final"]),
        "chamfer_mean_cm": _by_name(entry["mean"]),
        "energy": entry["energy"],
    }


def _by_name(row: dict[Variant, float]) -> dict[str, float]:
    return {variant.name: value for variant, value in row.items()}
