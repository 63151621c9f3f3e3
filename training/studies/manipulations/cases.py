"""One manipulation: its first half is fitted, all of it is predicted with what was found."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchcloth.episodes.observed import Episode, build_episode
from torchcloth.episodes.replay import Replay
from torchcloth.errors import SimulationDiverged, UnstableStep
from torchcloth.identification import Identification, identify
from torchcloth.identification.residuals.rigid_carry import carry_rigidly
from torchcloth.losses import chamfer_to_surface, chamfer_to_vertices

from .episodes import Seen, record
from .scenes import Discretisation, Fabric, Manipulation, Scene

SOUGHT = ("youngs_modulus", "poisson_ratio", "contact_stiffness", "shear_stiffness")  # the paper's four
FREE = ("bending.stiffness", "air.normal")  # unknown of any garment, and able to pass for the others


@dataclass(frozen=True)
class Setup:
    """What all cases of a study share.

    Attributes:
        triangles: of the fit's garment, about; the truth's has half as many again.
        gap: m between layers that touch, in the fit; 0.9 of it in the truth.
        rate: frames per second.
        points: of the cloth, per frame at most.
        share: of the frames that are fitted: later ones, folded and in contact, have slopes of no use.
        iterations: of a fit, at most.
    """

    triangles: int = 150
    gap: float = 0.05
    rate: float = 12.0
    points: int = 200
    share: float = 0.5
    iterations: int = 5

    @property
    def fit(self) -> Discretisation:
        """Of the model."""
        return Discretisation(self.triangles, self.gap)

    @property
    def truth(self) -> Discretisation:
        """Another mesh, grid and step."""
        return Discretisation(round(1.5 * self.triangles), 0.9 * self.gap, 0.6)


def seen(setup: Setup, what: Manipulation) -> tuple[Scene, Seen]:
    """The fit's scene, and the recording."""
    model = Scene(what, setup.fit)
    return model, record(Scene(what, setup.truth), model, setup.rate, setup.points)


def solve(setup: Setup, what: Manipulation) -> dict[str, Any]:
    """A finished case, plain JSON.

    "manipulation", "truth", "hidden", "found" (estimates), "moves_mm" (how far 10 % of each moves the cloth), "fit",
    "warnings", and "distance" for the rigid-carry null, the start values and the fitted ones, or "unpredicted":
    why there is none; or "failed": why.
    """
    model, data = seen(setup, what)
    true = Fabric.true(what.garment)
    case = {"manipulation": what.facts(), "truth": true.named(), "hidden": data.hidden, "frames": len(data.x)}
    start, early = model.cloth(true.start()), data.until(setup.share)
    try:
        fit = identify(start, early.recording, [*SOUGHT, *FREE], iterations=setup.iterations, warm_start=True)
    except (SimulationDiverged, UnstableStep) as error:
        return case | {"failed": str(error)}
    case |= stated(fit)
    try:
        return case | {"distance": _distances(setup, model, data, fit)}
    except (SimulationDiverged, UnstableStep) as error:  # later frames only: what was found stands
        return case | {"unpredicted": str(error)}


def solve_together(setup: Setup, whats: Sequence[Manipulation]) -> dict[str, Any]:
    """One fit to the first halves of several manipulations of a garment that is held at the same places; as ``solve``.

    Without "distance": nothing is predicted.
    """
    both = [seen(setup, what) for what in whats]
    model, true = both[0][0], Fabric.true(whats[0].garment)
    case = {"manipulations": [what.facts() for what in whats], "truth": true.named()}
    recordings = [data.until(setup.share).recording for _, data in both]
    try:
        fit = identify(
            model.cloth(true.start()), recordings, [*SOUGHT, *FREE], iterations=setup.iterations, warm_start=True
        )
    except (SimulationDiverged, UnstableStep) as error:
        return case | {"failed": str(error)}
    return case | stated(fit)


def stated(fit: Identification) -> dict[str, Any]:
    """What a case keeps of a fit."""
    found = {
        name: {"value": e.value, "std": e.std, "ci95": list(e.ci95), "start": e.initial, "identifiable": e.identifiable}
        for name, e in fit.parameters.items()
        if name in (*SOUGHT, *FREE)
    }
    keys = ("iterations", "simulations", "seconds", "points", "independent_observations", "converged")
    return {
        "found": found,
        "moves_mm": {name: i.displacement_per_10_percent_mm for name, i in fit.influences.items()},
        "fit": {key: fit.fit[key] for key in keys},
        "warnings": fit.warnings,
    }


def _distances(setup: Setup, model: Scene, data: Seen, fit: Identification) -> dict[str, dict[str, float]]:
    """State -> convention -> m, over all frames: most of them were not fitted."""
    start = Fabric.true(model.what.garment).start()
    fitted = Fabric(*(fit.parameters[name].value for name in start.named()))
    clouds = build_episode(model.cloth(start), data.recording)
    frames = {"null": carry_rigidly(clouds)}
    for state, fabric in (("start", start), ("fit", fitted)):
        with torch.no_grad():
            frames[state] = Replay(model.cloth(fabric))(clouds).x
    faces = torch.as_tensor(model.mesh.faces)
    return {state: distance(x, clouds, data.x, faces) for state, x in frames.items()}


def distance(x: Tensor, clouds: Episode, truth: Tensor, faces: Tensor) -> dict[str, float]:
    """Of frames [T, V, 3] m, over all but the first, where the cloth is given.

    "surface": cloud to surface, ours; "vertices": cloud to the nearest vertex, the paper's; "pose": root mean square
    of the vertices' distances from where they are in truth, hidden ones included.
    """
    rows = [
        (
            float(chamfer_to_surface(cloud, now, faces)),
            float(chamfer_to_vertices(cloud, now)),
            float((now - true).square().sum(-1).mean()),
        )
        for cloud, now, true in zip(clouds.clouds[1:], x[1:], truth[1:], strict=True)
    ]
    surface, vertices, squares = (sum(column) / len(rows) for column in zip(*rows, strict=True))
    return {"surface": surface, "vertices": vertices, "pose": math.sqrt(squares)}
