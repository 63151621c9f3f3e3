"""Where the cloth was, how well that is known, and what it took."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from .._utils.files import atomically, write_text
from ..cloth import Cloth
from ..episodes.unknowns import available
from ..identification.result import or_none
from ..identification.uncertainty.estimates import Estimate
from ..types import ClothState

CONVENTION = (
    "SI units, world frame, as the observer of the recording sees it. chamfer, rms: one-sided, cloud to surface, as in "
    "identification.json; null: carried rigidly; alone: simulated without corrective force; after: the estimate. "
    "force_share: root mean square over cloth and time of the corrective force over the weight. std in pose.npz: "
    "standard error of a coordinate; 95 % within 1.96 of them. seen: a point within 2 cm or a marker lies on a "
    "triangle of the vertex; where points are sparser than vertices, as many edges away as the points are apart."
)


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """The result of ``estimate_pose``: one continuous motion under gravity, air, grippers and a small extra force.

    Attributes:
        times: [T] s, the recording's frames.
        x: [T, V, 3] m.
        v: [T, V, 3] m/s.
        std: [T, V, 3] m, standard error of every coordinate.
        seen: [T, V] bool, as of ``seen_vertices``; False: hidden, so that only the dynamics and what was seen elsewhere
            tell where it is.
        faces: [F, 3].
        windows: [W, 2] s, in each of which the corrective force is constant.
        acceleration: [W, V, 3] m/s^2, corrective force over mass.
        shares: [W] of the corrective force in the weight, rms over the cloth.
        alone: [T, V, 3] m, the simulation without corrective force.
        null: [T, V, 3] m, the cloth carried rigidly.
        last: the simulation's state at the last frame, to go on from; with ``Cloth.forward`` of the same model, after
            ``apply`` where values were uncertain.
        parameters: fabric parameters that were uncertain, as this episode has them.
        nuisances: the same of clock, grasp, camera, rim.
        fit: distances [m], shares, counts, seconds.
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
    shares: Tensor = field(repr=False)
    alone: Tensor = field(repr=False)
    null: Tensor = field(repr=False)
    last: ClothState = field(repr=False)
    parameters: Mapping[str, Estimate]
    nuisances: Mapping[str, Estimate]
    fit: Mapping[str, Any]
    warnings: list[str]

    def apply(self, cloth: Cloth) -> Cloth:
        """Set the values of the uncertain parameters, with which the estimate has moved, in ``cloth``; returns it."""
        names = available(cloth)
        for name, estimate in self.parameters.items():
            cloth.get_submodule(names[name]).set(estimate.value)  # type: ignore[operator]
        return cloth

    def as_dict(self) -> dict[str, Any]:
        """The content of pose.json."""
        return {
            "fit": {name: or_none(value) for name, value in self.fit.items()},
            "windows": self.windows.tolist(),
            "shares": self.shares.tolist(),
            "parameters": {name: asdict(estimate) for name, estimate in self.parameters.items()},
            "nuisances": {name: asdict(estimate) for name, estimate in self.nuisances.items()},
            "convention": CONVENTION,
            "warnings": self.warnings,
        }

    def save(self, folder: str | Path) -> tuple[Path, Path]:
        """Write pose.npz (arrays) and pose.json (figures, warnings) into ``folder``, each atomically; their paths."""
        folder = Path(folder)
        names = ("times", "x", "v", "std", "seen", "faces", "windows", "acceleration", "alone")
        arrays = {name: getattr(self, name).cpu().numpy() for name in names}
        small = {name: a.astype(np.float32) if a.ndim == 3 else a for name, a in arrays.items()}
        text = json.dumps(self.as_dict(), indent=1, allow_nan=False) + "\n"
        with atomically(folder / "pose.npz") as part:
            np.savez_compressed(part, **small)
        return folder / "pose.npz", write_text(folder / "pose.json", text)
