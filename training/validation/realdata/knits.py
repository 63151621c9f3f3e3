"""Adapter: hand-pulled tension of knits with tracked pins, one table per fabric and direction.

The source is github sabetta/stitch-by-stitch, MIT (Singal et al., Nat. Commun. 15:2622, 2024). Tables hold force,
displacement and lateral strain.

Pins: strains are those between the pins, not between the clamps. X is taken as the warp, Y as the weft. Rows: medians
over equal steps of strain, so that the load cell's spikes and its steps of 0.1 N do not matter. A repeat's first second
gives its distances at zero force. Repeats 1 to 3 are read; 4 and 5 are reserved for checking predictions. At the start
most fabrics get wider, by up to 3 %, because their curled edges flatten. No sheet model does that. Unknown are the
areal density and the thickness. The width of `Acrylic_Yarn_Garter_X` must be wrong: its pins are 49 mm apart across 35
mm of cloth.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from torchcloth import Cloth, meshes
from torchcloth.materials import OrthotropicAEP
from torchcloth.recordings import ForceDisplacement

FITTED_REPEATS = (1, 2, 3)
SUSPECT_SAMPLE = "Acrylic_Yarn_Garter_X"
STRAIN_STEPS = 40  # rows of a repeat
MIN_FRAMES_PER_STEP = 3  # steps with fewer frames are left out
REST_FRAMES = 30  # about a second
KNIT_NOMINAL_THICKNESS_M = 1e-3
KNIT_PARAMETERS = ["youngs_modulus", "weft_modulus", "poisson_ratio", "warp_stiffening", "weft_stiffening"]


@lru_cache(1)
def read_tables(path: Path) -> dict[str, ForceDisplacement]:
    """Read the tables by sample, e.g. "Pearlized_Cotton_Rib_X"."""
    with np.load(path / "force_pins.npz") as file:
        data = {key: file[key].astype(float) for key in file.files}
    samples = sorted({key.split("/")[0] for key in data})
    return {name: _make_table(name, data) for name in samples}


def read_fabrics(path: Path) -> dict[str, tuple[ForceDisplacement, ForceDisplacement]]:
    """Read both directions of each fabric by its name, without the one whose width is suspect."""
    tables = read_tables(path)
    names = [name[:-2] for name in tables if name.endswith("_X") and name != SUSPECT_SAMPLE]
    return {name: (tables[f"{name}_X"], tables[f"{name}_Y"]) for name in names}


def _make_table(name: str, data: dict[str, np.ndarray]) -> ForceDisplacement:
    pulls = [_reduce_pull(data[f"{name}/video{k}"]) for k in FITTED_REPEATS]
    length, across = np.mean([first for first, _ in pulls], axis=0).tolist()
    rows = [np.column_stack([np.full(len(r), k), r]) for k, (_, r) in zip(FITTED_REPEATS, pulls, strict=True)]
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
            "distance of the lateral pins (m)": across,
            "not known": "areal density, thickness" + (", width (suspect)" if name == SUSPECT_SAMPLE else ""),
        },
    )


def _reduce_pull(video: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return first distances [2] m of the axial and lateral pins, and rows of strain, force [N] and lateral strain."""
    _, force, along, across, _ = video.T
    length, width = np.median(along[:REST_FRAMES]), np.median(across[:REST_FRAMES])
    strain = along / length - 1
    step = np.clip((strain / strain.max() * STRAIN_STEPS).astype(int), 0, STRAIN_STEPS - 1)
    measured = [k for k in range(STRAIN_STEPS) if (step == k).sum() >= MIN_FRAMES_PER_STEP]
    rows = [[np.median(v[step == k]) for v in (strain, force, across / width - 1)] for k in measured]
    return 1e-3 * np.array([length, width]), np.array(rows)


def initial_cloth() -> Cloth:
    """Return the cloth to start from: a soft knit that stiffens up to all measured strains."""
    law = OrthotropicAEP(
        1e4,
        1e4,
        5e3,
        0.3,
        warp_stiffening=1.0,
        weft_stiffening=1.0,
        stiffening_reach=3.0,
        thickness=KNIT_NOMINAL_THICKNESS_M,
    )
    return Cloth(meshes.rectangle(0.1, 0.1, triangles=8), law, 0.2, contact=None)
