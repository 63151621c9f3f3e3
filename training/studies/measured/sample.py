"""The sample released by the DiffCP paper's authors: Chamfer distances of null, start and fit in both directions.

248 points of 8 clouds; what the simulation assumes is in the adapter (validation/realdata/diffcp_sample.py).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchcloth.identification import build_cloth, build_episode, identify
from torchcloth.losses import chamfer_to_surface, chamfer_to_vertices
from torchcloth.recordings import Recording

from ...validation.realdata import diffcp_sample

SOURCE_NAME = "diffcp_sample"
FITTED_NAMES = ["youngs_modulus"]
SAMPLE_FIT_ITERATIONS = 3
CLOUD_COUNT = {True: 3, False: None}  # by ``fast``


def recording(source: Path, fast: bool) -> Recording:
    """Read the episode of the sample, with all clouds or a few."""
    return diffcp_sample.read_recording(source, count=CLOUD_COUNT[fast])


def run(source: Path, out: Path, journal: Path, fast: bool) -> dict[str, Any]:
    """Fit the membrane stiffness and compute the distances of all models."""
    given = recording(source, fast)
    cloth = build_cloth(given)
    resume = (journal / "problem").exists()
    fit = identify(
        cloth, given, FITTED_NAMES, iterations=1 if fast else SAMPLE_FIT_ITERATIONS, journal=journal, resume=resume
    )
    fit.save(out)
    data, faces = build_episode(cloth, given), torch.as_tensor(cloth.mesh.faces)
    still = data.initial.expand(len(data.times), -1, -1)
    models = {
        "left where it lay": still,
        "null: carried rigidly": fit.frames_null[0],
        "start: 300 N/m": fit.frames_before[0],
        "fitted": fit.frames_after[0],
    }
    estimate = {
        key: fit.parameters["membrane_stiffness"].__dict__[key] for key in ("value", "std", "ci95", "identifiable")
    }
    return {
        "distances": {name: distances(x, data.clouds, faces) for name, x in models.items()},
        "stiffness": estimate,
        "warnings": fit.warnings,
        "points": int(sum(map(len, data.clouds))),
    }


def distances(frames: Tensor, clouds: list[Tensor], faces: Tensor) -> dict[str, float]:
    """Return means over the frames [m]: cloud to surface, cloud to nearest vertex, vertices to nearest point."""
    pairs = [(cloud, x) for cloud, x in zip(clouds, frames, strict=True) if len(cloud)]
    to_surface = [float(chamfer_to_surface(cloud, x, faces)) for cloud, x in pairs]
    to_vertices = [float(chamfer_to_vertices(cloud, x)) for cloud, x in pairs]
    from_vertices = [float(chamfer_to_vertices(x, cloud)) for cloud, x in pairs]
    distances = {
        "cloud to surface": to_surface,
        "cloud to vertices": to_vertices,
        "vertices to cloud": from_vertices,
    }
    return {name: sum(values) / len(values) for name, values in distances.items()}
