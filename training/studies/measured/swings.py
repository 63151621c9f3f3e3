"""IRI swings: air and damping from 20 runs.

Only ratios to the unknown areal density are in these data, so it is set to a nominal value and ratios are reported. The
hanger's and the camera's errors are one nuisance, the camera's pose: the simulation does not care where it takes place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from torchcloth import effects, materials, meshes, recordings
from torchcloth.cloth import Cloth
from torchcloth.identification import Identification, build_cloth, identify

from ...validation.realdata import swings

SOURCE = "iri_cloth_swings"
DENSITY = 0.3  # kg/m^2, nominal: only ratios to it are seen
STIFFNESS, POISSON = 100.0, 0.2  # N/m, assumed: 0.4 % longer under its own weight, 0.2 % of the frequency
ROWS, COLUMNS = 13, 5  # of vertices: 96 triangles, 0.3 % off the chain's frequency
EVERY = 2  # frames that are used of a whole run
HELD_OUT = 3  # every third run is predicted
NAMES = ["air.normal", "added.length", "damping.rate"]
START = {"air.normal": 1.2, "added.length": 0.113, "damping.rate": 0.0}  # plate across a stream; ideal fluid, 0.377 L
PRIORS = {"air.normal": (1.2, 10.0)}  # wide: a plate shaken over a fraction of its width has ten times the drag
NUISANCES = {"clock": 0.03, "camera": 0.02}
EFFECTS = {"drag per areal density": "1/m", "added mass per areal density": "-", "damping rate": "1/s"}


def split(source: Path, fast: bool) -> tuple[list[str], list[str]]:
    """Names of fitted and of predicted runs."""
    names = sorted(swings.runs(source))
    held = names[HELD_OUT - 1 :: HELD_OUT]
    fitted = [name for name in names if name not in held]
    return (fitted[::10], held[4:5]) if fast else (fitted, held)


def recording(source: Path, name: str, every: int = 1) -> recordings.Recording:
    """One run on the study's mesh, with some of its frames."""
    mesh = _mesh()
    found = swings.episode(source, name)
    cloth = replace(
        found.cloth,
        sheet=None,
        vertices=mesh.vertices,
        faces=mesh.faces,
        uv=mesh.uv,
        initial_vertices=found.cloth.interpolate_initial_positions(mesh.uv),
        areal_density=DENSITY,
        areal_density_std=None,
    )
    chosen = np.arange(len(found.points)) % every == 0
    return replace(found, cloth=cloth, points=found.points.select(chosen), path=Path(name))


def _mesh() -> meshes.Mesh:
    side = swings.SIDE
    return meshes.rectangle(side, side, resolution=(COLUMNS, ROWS))


def cloth_of(run: recordings.Recording, values: dict[str, float]) -> Cloth:
    """The hanging cloth in air of these values."""
    parts = {
        "gravity": effects.Gravity(),
        "air": effects.AirDrag(values["air.normal"], swings.AIR),
        "added": effects.AddedMass(values["added.length"], swings.AIR),
        "damping": effects.MassDamping(values["damping.rate"]),
        "bending": effects.Bending(swings.BENDING, swings.DAMPING),
    }
    return build_cloth(run, materials.AEP(STIFFNESS / 1e-3, POISSON, thickness=1e-3), parts)


def fit(source: Path, names: Sequence[str], journal: Path, fast: bool) -> Identification:
    """Drag, added mass and damping from these runs; goes on where a stopped fit was. Fast: two steps, all frames."""
    runs = [recording(source, name, EVERY) for name in names]
    cloth = cloth_of(runs[0], START)
    resume = (journal / "problem").exists()
    brief = {"iterations": 2, "warm_start": True} if fast else {}
    return identify(cloth, runs, NAMES, nuisances=NUISANCES, priors=PRIORS, journal=journal, resume=resume, **brief)


def ratios(fit: dict[str, Any]) -> dict[str, dict[str, float | bool]]:
    """What is identifiable, from the parameters of identification.json: ratios to the areal density, and the rate."""
    air, out = swings.AIR, {}
    for effect, key, factor in zip(EFFECTS, NAMES, (air / DENSITY, air / DENSITY, 1.0), strict=True):
        found = fit[key]
        low, high = found["ci95"]
        numbers = {"value": found["value"], "std": found["std"], "low": low, "high": high}
        scaled = {name: factor * number for name, number in numbers.items()}
        out[effect] = {**scaled, "identifiable": found["identifiable"]}
    return out
