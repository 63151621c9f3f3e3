"""Adapter: hand-pulled tension of knits with tracked pins (github sabetta/stitch-by-stitch, MIT; Singal et al., Nat.
Commun. 15:2622, 2024), as tables of force, displacement and lateral strain, one per fabric and direction.

Pins: strains are those between the pins, not between the clamps; X is taken as the warp, Y as the weft. Rows: the
medians of ROWS equal steps of strain, so that the load cell's spikes and its steps of 0.1 N do not matter. A repeat's
first second gives its distances at no force. Repeats 1 to 3; 4 and 5 are kept by others for checking predictions.
At the start most fabrics get wider, by up to 3 %: their edges, curled, flatten. No sheet does that. Not known: areal
density, thickness. The width of `Acrylic_Yarn_Garter_X` must be wrong: its pins are 49 mm apart across 35 mm of cloth.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from torchcloth import Cloth, meshes
from torchcloth.materials import OrthotropicAEP
from torchcloth.recordings import ForceDisplacement

REPEATS = (1, 2, 3)
SUSPECT = "Acrylic_Yarn_Garter_X"
ROWS = 40
FIRST = 30  # frames, about a second
H = 1e-3  # m, nominal
NAMES = ["youngs_modulus", "weft_modulus", "poisson_ratio", "warp_stiffening", "weft_stiffening"]


@lru_cache(1)
def tables(path: Path) -> dict[str, ForceDisplacement]:
    """By sample, e.g. "Pearlized_Cotton_Rib_X"."""
    with np.load(path / "force_pins.npz") as file:
        data = {key: file[key].astype(float) for key in file.files}
    samples = sorted({key.split("/")[0] for key in data})
    return {name: _table(name, data) for name in samples}


def fabrics(path: Path) -> dict[str, tuple[ForceDisplacement, ForceDisplacement]]:
    """Both directions of a fabric by its name; without the one whose width is suspect."""
    found = tables(path)
    names = [name[:-2] for name in found if name.endswith("_X") and name != SUSPECT]
    return {name: (found[f"{name}_X"], found[f"{name}_Y"]) for name in names}


def _table(name: str, data: dict[str, np.ndarray]) -> ForceDisplacement:
    pulls = [_pull(data[f"{name}/video{k}"]) for k in REPEATS]
    length, across = np.mean([first for first, _ in pulls], axis=0).tolist()
    rows = [np.column_stack([np.full(len(r), k), r]) for k, (_, r) in zip(REPEATS, pulls, strict=True)]
    repeat, strain, force, lateral = np.concatenate(rows).T
    return ForceDisplacement(
        length=length,
        width=1e-3 * float(data[f"{name}/fabric_width_at_clamp_mm"]),
        angle=0.0 if name.endswith("_X") else np.pi / 2,
        displacement=strain * length,
        force=force,
        lateral_strain=lateral,
        repeat=repeat.astype(int),
        licence="MIT",
        extra={
            "source": f"github sabetta/stitch-by-stitch, {name}; Singal et al. 2024",
            "pins apart across (m)": across,
            "not known": "areal density, thickness" + (", width (suspect)" if name == SUSPECT else ""),
        },
    )


def _pull(video: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First distances of the axial and lateral pins m; rows of strain, force N and lateral strain."""
    _, force, along, across, _ = video.T
    first, wide = np.median(along[:FIRST]), np.median(across[:FIRST])
    strain = along / first - 1
    step = np.clip((strain / strain.max() * ROWS).astype(int), 0, ROWS - 1)
    full = [k for k in range(ROWS) if (step == k).sum() >= 3]
    rows = [[np.median(v[step == k]) for v in (strain, force, across / wide - 1)] for k in full]
    return 1e-3 * np.array([first, wide]), np.array(rows)


def start() -> Cloth:
    """A soft knit that stiffens up to any strain seen here."""
    law = OrthotropicAEP(
        1e4, 1e4, 5e3, 0.3, warp_stiffening=1.0, weft_stiffening=1.0, stiffening_reach=3.0, thickness=H
    )
    return Cloth(meshes.rectangle(0.1, 0.1, triangles=8), law, 0.2, contact=None)
