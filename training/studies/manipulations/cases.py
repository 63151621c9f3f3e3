"""A case: the first half of a manipulation is fitted, and all of it is predicted with the estimates.

This library simulates the truth, with the laws that are fitted. Fits therefore state ``SAME_SIMULATOR``: the standard
errors contain no error between two simulators.
"""

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
from torchcloth.identification.uncertainty.model_error import SAME_SIMULATOR
from torchcloth.losses import chamfer_to_surface, chamfer_to_vertices

from .episodes import Observation, record
from .scenes import Discretisation, Fabric, Manipulation, Scene

PAPER_PARAMETERS = ("youngs_modulus", "poisson_ratio", "contact_stiffness", "shear_stiffness")  # the paper's four
EXTRA_PARAMETERS = (
    "bending.stiffness",
    "air.normal",
)  # unknown for any garment, and confounded with the others if they are not fitted


@dataclass(frozen=True)
class Setup:
    """Settings that all cases of a study share.

    Attributes:
        triangles: approximate number in the fit; the truth has 1.5 times as many.
        gap: distance of layers that touch [m] in the fit; 0.9 of it in the truth.
        rate: frames per second.
        points: most points of the cloth in a frame.
        share: fraction of the frames that are fitted; late frames with folds and contact have useless slopes.
        iterations: most iterations of a fit.
    """

    triangles: int = 150
    gap: float = 0.05
    rate: float = 12.0
    points: int = 200
    share: float = 0.5
    iterations: int = 5

    @property
    def fit(self) -> Discretisation:
        """Discretisation of the model."""
        return Discretisation(self.triangles, self.gap)

    @property
    def truth(self) -> Discretisation:
        """Discretisation of the truth, with another mesh, grid and step."""
        return Discretisation(round(1.5 * self.triangles), 0.9 * self.gap, 0.6)


def simulate_observation(setup: Setup, what: Manipulation) -> tuple[Scene, Observation]:
    """Return the fit's scene and the observation of the truth."""
    model = Scene(what, setup.fit)
    return model, record(Scene(what, setup.truth), model, setup.rate, setup.points)


def solve_case(setup: Setup, what: Manipulation) -> dict[str, Any]:
    """Fit and predict a case; return plain JSON.

    Keys: "manipulation", "truth", "hidden", "estimates", "moves_mm" (motion of the cloth by 10 % of each parameter),
    "fit", "warnings", and "distance" of the rigid-carry null, the start values and the fitted values. "unpredicted"
    replaces "distance" if the prediction failed, and "failed" replaces all results if the fit failed.
    """
    model, data = simulate_observation(setup, what)
    true = Fabric.true(what.garment)
    case = {"manipulation": what.facts(), "truth": true.named(), "hidden": data.hidden, "frames": len(data.x)}
    start, early = model.cloth(true.start()), data.until(setup.share)
    try:
        fit = identify(
            start,
            early.recording,
            [*PAPER_PARAMETERS, *EXTRA_PARAMETERS],
            iterations=setup.iterations,
            warm_start=True,
            model_errors=SAME_SIMULATOR,
            exact_bench=True,
        )
    except (SimulationDiverged, UnstableStep) as error:
        return case | {"failed": str(error)}
    case |= extract_fit(fit)
    try:
        return case | {"distance": _distances(setup, model, data, fit)}
    except (SimulationDiverged, UnstableStep) as error:  # in later frames only: the estimates stand
        return case | {"unpredicted": str(error)}


def solve_together(setup: Setup, manipulations: Sequence[Manipulation]) -> dict[str, Any]:
    """Fit the first halves of several manipulations of a garment with the same grips; see ``solve_case``.

    There is no "distance", because nothing is predicted.
    """
    observations = [simulate_observation(setup, what) for what in manipulations]
    model, true = observations[0][0], Fabric.true(manipulations[0].garment)
    case = {"manipulations": [what.facts() for what in manipulations], "truth": true.named()}
    recordings = [data.until(setup.share).recording for _, data in observations]
    try:
        fit = identify(
            model.cloth(true.start()),
            recordings,
            [*PAPER_PARAMETERS, *EXTRA_PARAMETERS],
            iterations=setup.iterations,
            warm_start=True,
            model_errors=SAME_SIMULATOR,
            exact_bench=True,
        )
    except (SimulationDiverged, UnstableStep) as error:
        return case | {"failed": str(error)}
    return case | extract_fit(fit)


def extract_fit(fit: Identification) -> dict[str, Any]:
    """Return the parts of a fit that a case stores."""
    estimates = {
        name: {"value": e.value, "std": e.std, "ci95": list(e.ci95), "start": e.initial, "identifiable": e.identifiable}
        for name, e in fit.parameters.items()
        if name in (*PAPER_PARAMETERS, *EXTRA_PARAMETERS)
    }
    keys = ("iterations", "simulations", "seconds", "points", "effective_observations", "converged")
    return {
        "estimates": estimates,
        "moves_mm": {name: i.displacement_per_10_percent_mm for name, i in fit.influences.items()},
        "fit": {key: fit.fit[key] for key in keys},
        "warnings": fit.warnings,
    }


def _distances(setup: Setup, model: Scene, data: Observation, fit: Identification) -> dict[str, dict[str, float]]:
    """Return state -> convention -> distance [m] over all frames, most of which were not fitted."""
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
    """Compute distances [m] of frames [T, V, 3] m, over all but the first, where the cloth is given.

    "surface": cloud to surface (ours). "vertices": cloud to the nearest vertex (the paper's). "pose": root mean square
    distance of all vertices from their true places, hidden ones included.
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
