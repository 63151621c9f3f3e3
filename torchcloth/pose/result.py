"""The result of a pose estimate: where the cloth was, how well that is known, and the force that it took."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from .._utils.files import write_atomically, write_text
from ..cloth import Cloth
from ..episodes.unknowns import find_scalar_parameters
from ..identification.result import nan_to_none
from ..identification.uncertainty.estimates import Estimate
from ..types import ClothState

POSE_SCHEMA = "torchcloth.pose/1"
POSE_CONVENTION = (
    "SI units, world frame, as the observer of the recording sees it. chamfer, rms: one-sided, cloud to surface, as in "
    "identification.json; null: carried rigidly; uncorrected: simulated without corrective force; after: the estimate. "
    "force_fraction: root mean square over cloth and time of the corrective force over the weight. std in pose.npz: "
    "standard error of a coordinate; the 95 % interval is 1.96 of them to either side. seen: a point within 2 cm or a "
    "marker lies on a triangle of the vertex. Where points are sparser than vertices, the triangle may be as many "
    "edges away as the points are apart."
)


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """The result of ``estimate_pose``: one continuous motion under gravity, air, grippers and a corrective force.

    Attributes:
        times: [T] s, the recording's frames.
        x: [T, V, 3] m.
        v: [T, V, 3] m/s.
        std: [T, V, 3] m, standard error of every coordinate.
        seen: [T, V] bool, as of ``find_seen_vertices``. A hidden vertex is known only by the dynamics and by data on
            other parts of the cloth.
        faces: [F, 3].
        windows: [W, 2] s, in each of which the corrective force is constant.
        acceleration: [W, V, 3] m/s^2, corrective force over mass.
        force_fractions: [W] corrective force over weight, rms over the cloth.
        uncorrected: [T, V, 3] m, the simulation without corrective force.
        rigid_carry: [T, V, 3] m, the cloth carried rigidly.
        last_state: the simulation's state at the last frame, from which ``Cloth.forward`` of the same model can go on;
            after ``apply`` where values were uncertain.
        parameters: fabric parameters that were uncertain, as this episode has them.
        nuisances: estimates of clock, grasp, camera, rim.
        fit: distances [m], fractions, counts, seconds.
        warnings: what to mistrust, in sentences.
    """

    times: Tensor
    x: Tensor = field(repr=False)
    v: Tensor = field(repr=False)
    std: Tensor = field(repr=False)
    seen: Tensor = field(repr=False)
    faces: Tensor = field(repr=False)
    windows: Tensor = field(repr=False)
    acceleration: Tensor = field(repr=False)
    force_fractions: Tensor = field(repr=False)
    uncorrected: Tensor = field(repr=False)
    rigid_carry: Tensor = field(repr=False)
    last_state: ClothState = field(repr=False)
    parameters: Mapping[str, Estimate]
    nuisances: Mapping[str, Estimate]
    fit: Mapping[str, Any]
    warnings: list[str]

    def apply(self, cloth: Cloth) -> Cloth:
        """Set the values of the uncertain parameters, with which the estimate moved, in ``cloth``, and return it."""
        paths = find_scalar_parameters(cloth)
        for name, estimate in self.parameters.items():
            cloth.get_submodule(paths[name]).set(estimate.value)  # type: ignore[operator]
        return cloth

    def as_dict(self) -> dict[str, Any]:
        """Return the content of pose.json."""
        return {
            "schema": POSE_SCHEMA,
            "fit": {name: nan_to_none(value) for name, value in self.fit.items()},
            "windows": self.windows.tolist(),
            "force_fractions": self.force_fractions.tolist(),
            "parameters": {name: asdict(estimate) for name, estimate in self.parameters.items()},
            "nuisances": {name: asdict(estimate) for name, estimate in self.nuisances.items()},
            "convention": POSE_CONVENTION,
            "warnings": self.warnings,
        }

    def save(self, folder: str | Path) -> tuple[Path, Path]:
        """Write pose.npz (arrays) and pose.json (numbers, warnings) into ``folder`` atomically; return their paths."""
        folder = Path(folder)
        names = ("times", "x", "v", "std", "seen", "faces", "windows", "acceleration", "uncorrected")
        arrays = {name: getattr(self, name).cpu().numpy() for name in names}
        stored = {name: a.astype(np.float32) if a.ndim == 3 else a for name, a in arrays.items()}
        text = json.dumps(self.as_dict(), indent=1, allow_nan=False) + "\n"
        with write_atomically(folder / "pose.npz") as part:
            np.savez_compressed(part, **stored)
        return folder / "pose.npz", write_text(folder / "pose.json", text)
