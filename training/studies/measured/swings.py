"""IRI swings: air and damping from 20 runs.

The data determine only ratios to the unknown areal density. So it is set to a nominal value, and ratios are reported.
The errors of hanger and camera are one nuisance, the camera's pose, because the simulation is invariant to its place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from torchcloth import effects, materials, meshes, recordings
from torchcloth._utils.constants import STANDARD_AIR_DENSITY_KG_PER_M3
from torchcloth.cloth import Cloth
from torchcloth.identification import Identification, build_cloth, identify

from ...validation.realdata import swings

SOURCE_NAME = "iri_cloth_swings"
NOMINAL_DENSITY_KG_PER_M2 = 0.3  # kg/m^2, nominal: only ratios to it are seen
ASSUMED_STIFFNESS_N_PER_M, ASSUMED_POISSON_RATIO = (
    100.0,
    0.2,
)  # N/m, assumed: 0.4 % longer under its own weight, 0.2 % of the frequency
MESH_ROWS, MESH_COLUMNS = 13, 5  # of vertices: 96 triangles, 0.3 % off the chain's frequency
FRAME_STRIDE = 2  # frames that are used of a whole run
PREDICTED_STRIDE = 3  # every third run is predicted
FITTED_NAMES = ["air.normal", "added.length", "damping.rate"]
START_VALUES = {
    "air.normal": 1.2,
    "added.length": 0.113,
    "damping.rate": 0.0,
}  # plate across a flow; ideal fluid, 0.377 L
PRIORS = {"air.normal": (1.2, 10.0)}  # wide, because a plate shaken by a fraction of its width has ten times the drag
NUISANCES = {"clock": 0.03, "camera": 0.02}
RATIO_UNITS = {"drag per areal density": "1/m", "added mass per areal density": "-", "damping rate": "1/s"}


def split(source: Path, fast: bool) -> tuple[list[str], list[str]]:
    """Return the names of fitted and of predicted runs."""
    names = sorted(swings.read_runs(source))
    predicted = names[PREDICTED_STRIDE - 1 :: PREDICTED_STRIDE]
    fitted = [name for name in names if name not in predicted]
    return (fitted[::10], predicted[4:5]) if fast else (fitted, predicted)


def recording(source: Path, name: str, every: int = 1) -> recordings.Recording:
    """Return a run on the study's mesh, with each ``every``-th frame."""
    mesh = _mesh()
    episode = swings.read_episode(source, name)
    assert mesh.uv is not None
    assert episode.points is not None
    cloth = replace(
        episode.cloth,
        sheet=None,
        vertices=mesh.vertices,
        faces=mesh.faces,
        uv=mesh.uv,
        initial_vertices=episode.cloth.interpolate_initial_positions(mesh.uv),
        areal_density=NOMINAL_DENSITY_KG_PER_M2,
        areal_density_std=None,
    )
    chosen = np.arange(len(episode.points)) % every == 0
    return replace(episode, cloth=cloth, points=episode.points.select(chosen), path=Path(name))


def _mesh() -> meshes.Mesh:
    side = swings.SHEET_SIDE_M
    return meshes.rectangle(side, side, resolution=(MESH_COLUMNS, MESH_ROWS))


def cloth_of(run: recordings.Recording, values: dict[str, float]) -> Cloth:
    """Build the hanging cloth in air with these values."""
    parts = {
        "gravity": effects.Gravity(),
        "air": effects.AirDrag(values["air.normal"], density=STANDARD_AIR_DENSITY_KG_PER_M3),
        "added": effects.AddedMass(values["added.length"], STANDARD_AIR_DENSITY_KG_PER_M3),
        "damping": effects.MassDamping(values["damping.rate"]),
        "bending": effects.Bending(swings.IRI_BENDING_N_M, swings.IRI_DAMPING_TIME_S),
    }
    return build_cloth(
        run, materials.AEP(ASSUMED_STIFFNESS_N_PER_M / 1e-3, ASSUMED_POISSON_RATIO, thickness=1e-3), parts
    )


def fit(source: Path, names: Sequence[str], journal: Path, fast: bool) -> Identification:
    """Fit drag, added mass and damping to these runs, resuming a stopped fit; ``fast``: two steps on all frames."""
    runs = [recording(source, name, FRAME_STRIDE) for name in names]
    cloth = cloth_of(runs[0], START_VALUES)
    resume = (journal / "problem").exists()
    brief = {"iterations": 2, "warm_start": True} if fast else {}
    return identify(
        cloth, runs, FITTED_NAMES, nuisances=NUISANCES, priors=PRIORS, journal=journal, resume=resume, **brief
    )


def ratios(fit: dict[str, Any]) -> dict[str, dict[str, float | bool]]:
    """Return the identifiable quantities: ratios to the areal density, and the damping rate."""
    air, out = STANDARD_AIR_DENSITY_KG_PER_M3, {}
    for effect, key, factor in zip(
        RATIO_UNITS, FITTED_NAMES, (air / NOMINAL_DENSITY_KG_PER_M2, air / NOMINAL_DENSITY_KG_PER_M2, 1.0), strict=True
    ):
        estimate = fit[key]
        low, high = estimate["ci95"]
        numbers = {"value": estimate["value"], "std": estimate["std"], "low": low, "high": high}
        scaled = {name: factor * number for name, number in numbers.items()}
        out[effect] = {**scaled, "identifiable": estimate["identifiable"]}
    return out
