"""What a fit says of an episode that it was not fitted to: where the cloth goes, how sure that is, how far off."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..cloth import Cloth
from ..errors import RecordingError
from ..recordings import Recording
from .episodes import Episode, episode
from .misfit import figures, forces_rms
from .null import no_force, rigid_carry
from .replays import Frames, tangents
from .result import or_none
from .saved import read_saved, rebuilt, result_file
from .unknowns import Unknown, collect

CONVENTION = (
    "SI units. std_parameters: standard error [m] of a vertex's place (root mean square over the cloth and time, and "
    "the largest) by the covariance of the fitted parameters, linearised. std_law: rms distance that the fit left in "
    "its own episodes: sensor noise and what the law misses. rms, chamfer: of the measured points from the simulated "
    "surface, one-sided; null: the cloth carried rigidly by the grippers. Null (JSON) where nothing was seen."
)


@dataclass(frozen=True, eq=False)
class EpisodePrediction:
    """The result of ``predict_episode``.

    Attributes:
        cloth: with the fitted values.
        episode: what drives it, and what was seen.
        frames: [T, V, 3] m at ``episode.times``, forces on the grippers.
        std: [T, V] m, standard error of a vertex's place by the parameters' covariance (all three axes together).
        wrench_std: gripper -> [T, 6] N, N m, likewise.
        law: m, rms distance that the fit left in its own episodes.
        figures: distances [m] of what was seen, NaN where nothing was.
        per_frame: [T'] m, mean distance in the frames that have points.
    """

    cloth: Cloth
    episode: Episode
    frames: Frames
    std: Tensor
    wrench_std: dict[str, Tensor]
    law: float
    figures: dict[str, float]
    per_frame: Tensor

    def as_dict(self) -> dict[str, Any]:
        """The content of prediction.json."""
        return {
            "episode": self.episode.name,
            "frames": len(self.std),
            "std_parameters": {"rms": float(self.std.square().mean().sqrt()), "max": float(self.std.max())},
            "std_law": or_none(self.law),
            "measured": {name: or_none(value) for name, value in self.figures.items()},
            "convention": CONVENTION,
        }


def predict_episode(path: str | Path, recording: Recording) -> EpisodePrediction:
    """Simulate any episode of the fitted cloth with the fitted values, with errors from their covariance.

    Args:
        path: identification.json, or the folder that holds it.
        recording: describes the same kind of cloth; points, markers and forces are only compared with.

    Raises:
        InvalidInput: there is no such file, or the fit is of another model.
        RecordingError: the file cannot be read; or an episode that has no frames to predict.
    """
    path = result_file(path)
    model = read_saved(path)
    cloth = rebuilt(path, model, recording)
    unknowns, covariance, law = _known(path, cloth)
    data = episode(cloth, recording)
    raw = torch.tensor([u.start for u in unknowns], dtype=torch.float64)
    frames, moved = tangents(cloth, unknowns, raw, data, model.dt)
    spread = lambda slopes: torch.einsum("k...,kl,l...->...", slopes, covariance.to(slopes), slopes).clamp(min=0)  # noqa: E731
    seen, per_frame = distances(cloth, data, frames)
    return EpisodePrediction(
        cloth,
        data,
        frames,
        spread(moved.x).sum(-1).sqrt(),
        {name: spread(slopes).sqrt() for name, slopes in moved.wrench.items()},
        law,
        seen,
        per_frame,
    )


def _known(path: Path, cloth: Cloth) -> tuple[list[Unknown], Tensor, float]:
    """Fitted parameters at their values, the covariance [K, K] of the unconstrained ones, and the fit's rms [m]."""
    try:
        content = json.loads(path.read_text())
        correlation, said = content["correlation"], content["parameters"]
        unknowns = collect(cloth, list(correlation), None)
        matrix = torch.tensor([[correlation[a.name][b.name] for b in unknowns] for a in unknowns], dtype=torch.float64)
        stds = [float(said[u.name]["std"]) / u.slope(u.start) for u in unknowns]
        left = content["fit"]["rms_after"]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        expected, again = "parameters, correlation and fit", "run `torchcloth identify` again"
        raise RecordingError(f"{path}: is not complete", got=repr(error), expected=expected, remedy=again) from None
    deviation = torch.tensor(stds, dtype=torch.float64)
    return unknowns, matrix * deviation[:, None] * deviation, math.nan if left is None else float(left)


def distances(cloth: Cloth, data: Episode, frames: Frames) -> tuple[dict[str, float], Tensor]:
    """Distances [m] and force errors [N] of the prediction and of the null, and [T'] m of frames with points."""
    faces = torch.as_tensor(cloth.mesh.faces)
    found, null = (figures([x], [data], faces) for x in (frames.x, rigid_carry(data)))
    out = {"rms": found.rms, "rms_null": null.rms, "chamfer": found.chamfer, "chamfer_null": null.chamfer}
    if data.wrenches:
        out["force_rms"] = forces_rms([frames.wrench], [data])
        out["force_rms_null"] = forces_rms([no_force(data)], [data])
    return out, found.per_frame
