"""Cases of the fabric study: stretching trials, their information on k and gamma, and presses that determine these.

This library simulates the truth, with the law that is fitted. All fits therefore state ``SAME_SIMULATOR``: the error
between two simulators, 5 % of each parameter, does not occur here. It would hide the sensors' errors of 0.1 to 3 %,
whose coverage the study checks.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np

import torchcloth as tc
from torchcloth.identification import Identification, identify
from torchcloth.identification.uncertainty.model_error import SAME_SIMULATOR
from torchcloth.materials.presets import find_fabric

from ..resumable import Case
from . import pressing, stretching
from .paper_fabrics import FABRICS
from .pressing import Layer, Plates
from .stretching import Detail, Fabric, Pull

ASSUMED_DENSITY_KG_PER_M2 = {  # assumed, because the paper gives none
    "cotton": 0.15,
    "artificial_silk": 0.12,
    "wool": 0.25,
    "polyester": 0.15,
    "coated_nylon": 0.30,
}
ASSUMED_FRICTION_CONE = 0.3  # assumed, because the paper gives no friction between layers
ALL_PULLS = (
    Pull("x"),
    Pull("x", (0.0, 5 / 6)),
    Pull("x", (1 / 6, 1.0)),
    Pull("x", (1 / 6, 5 / 6)),
    Pull("y"),
    Pull("y", (0.0, 7 / 8)),
    Pull("y", (1 / 8, 1.0)),
    Pull("45"),
    Pull("45", (0.0, 5 / 6)),
    Pull("45", (1 / 6, 1.0)),
)
MEMBRANE_PARAMETERS = ("youngs_modulus", "poisson_ratio")
CONTACT_PARAMETERS = ("contact_stiffness", "shear_stiffness", "cone")
START_FACTOR, START_POISSON = 1.5, 0.2  # start over truth of E; start of nu
CLAMP_NUISANCE = {"grasp": 1e-3}  # prior standard deviation of the clamps' places [m]
GRID_SPACING_M = 0.0125


class Scale(NamedTuple):
    """Size of the study.

    Attributes:
        fabrics: names.
        pulls: stretching trials of each fabric.
        detail: of the stretching trials.
        presses: number of presses where the model has its plates.
        places: number of presses elsewhere in the grid.
        cells: along a side of a pressed layer, for truth and model.
    """

    fabrics: tuple[str, ...]
    pulls: tuple[Pull, ...]
    detail: Detail
    presses: int
    places: int
    cells: tuple[int, int]

    def settings(self) -> dict[str, Any]:
        """Return the settings that a case depends on; fabrics and pulls may be added later."""
        return {"detail": list(self.detail), "cells": list(self.cells), "refined": True, "turned": True}


FULL_SCALE = Scale(tuple(FABRICS), ALL_PULLS, Detail(), 3, 4, (6, 4))
FAST_SCALE = Scale(("cotton", "wool"), (ALL_PULLS[3], ALL_PULLS[5], ALL_PULLS[8]), Detail(0.05, 9, 80), 1, 2, (3, 2))


def sheet_fabric(name: str) -> Fabric:
    """Return a fabric of the paper as a sheet."""
    f = find_fabric(name).isotropic()
    return Fabric(f["youngs_modulus"] * f["thickness"], f["poisson_ratio"], ASSUMED_DENSITY_KG_PER_M2[name])


def pressed_layer(name: str) -> Layer:
    """Return a fabric of the paper as a pressed layer."""
    return Layer(**find_fabric(name).isotropic(), cone=ASSUMED_FRICTION_CONE, density=ASSUMED_DENSITY_KG_PER_M2[name])


def true_values(name: str) -> dict[str, float]:
    """Return the true values by the parameter names of the fit."""
    return {
        key: value
        for key, value in pressed_layer(name)._asdict().items()
        if key in (*MEMBRANE_PARAMETERS, *CONTACT_PARAMETERS)
    }


def stretch_cases(scale: Scale) -> dict[str, Case]:
    """Return the stretching trials by name."""
    return {
        f"{name}-pull-{ALL_PULLS.index(pull) + 1:02d}": partial(fit_stretch, name, pull, scale.detail)
        for name in scale.fabrics
        for pull in scale.pulls
    }


def other_cases(scale: Scale) -> dict[str, Case]:
    """Return the cases of contact parameters from the first trial, and the presses."""
    out: dict[str, Case] = {}
    for name in scale.fabrics:
        out[f"{name}-director"] = partial(fit_contact_from_stretch, name, scale)
        for kind, count in (("press", scale.presses), ("elsewhere", scale.places)):
            for i in range(count):
                out[f"{name}-{kind}-{i + 1:02d}"] = partial(fit_press, name, i, scale, kind == "elsewhere")
    return out


def seed_of(name: str, index: int) -> int:
    """Return the seed of a trial's noise, and of the place of a press in the grid."""
    return 100 * list(FABRICS).index(name) + index


def fit_stretch(name: str, pull: Pull, detail: Detail) -> dict[str, Any]:
    """Simulate and fit one stretching trial."""
    recording = stretching.record_trial(sheet_fabric(name), pull, seed_of(name, ALL_PULLS.index(pull)), detail)
    start = sheet_fabric(name)._replace(membrane=START_FACTOR * sheet_fabric(name).membrane, poisson=START_POISSON)
    model, began = stretching.build_sheet(recording, start), time.perf_counter()
    fit = identify(
        model,
        recording,
        MEMBRANE_PARAMETERS,
        nuisances=CLAMP_NUISANCE,
        refine=True,
        model_errors=SAME_SIMULATOR,
        exact_bench=True,
    )
    facts = {
        "direction": pull.direction,
        "clamps": pull.clamps,
        "strain": stretching.pull_strain(sheet_fabric(name), pull),
    }
    return {
        "fabric": name,
        **facts,
        **extract_estimates(fit, MEMBRANE_PARAMETERS),
        "seconds": time.perf_counter() - began,
    }


def fit_contact_from_stretch(name: str, scale: Scale) -> dict[str, Any]:
    """Fit the first trial with contact in the model, from the truth, to see what it says of k and gamma."""
    pull, properties = scale.pulls[0], pressed_layer(name)
    recording = stretching.record_trial(sheet_fabric(name), pull, seed_of(name, 0), scale.detail)
    contact = tc.Contact(spacing=2 * scale.detail.cell)
    model = stretching.build_sheet(
        recording, sheet_fabric(name), contact, properties.contact_stiffness, properties.shear_stiffness
    )
    names = (*MEMBRANE_PARAMETERS, *CONTACT_PARAMETERS[:2])
    dt = 0.7 * model.stable_step()  # one step for all k, because another step would change the rounding error
    fit = identify(
        model,
        recording,
        names,
        nuisances=CLAMP_NUISANCE,
        warm_start=True,
        iterations=1,
        dt=dt,
        model_errors=SAME_SIMULATOR,
        exact_bench=True,
    )
    return {"fabric": name, **extract_estimates(fit, names)}


def fit_press(name: str, index: int, scale: Scale, elsewhere: bool) -> dict[str, Any]:
    """Simulate and fit a press; ``elsewhere``: the truth's plates lie elsewhere in the contact grid, and turned."""
    properties, seed = pressed_layer(name), seed_of(name, 50 + index)
    fine, coarse = scale.cells
    truth = Plates(fine + index % 2, GRID_SPACING_M)
    truth = truth.moved_randomly(np.random.default_rng(1000 + seed)) if elsewhere else truth
    recording = pressing.record(properties, truth, seed)
    start = {
        "contact_stiffness": START_FACTOR * properties.contact_stiffness,
        "shear_stiffness": properties.shear_stiffness / START_FACTOR,
    }
    plates = Plates(coarse, GRID_SPACING_M)
    model = pressing.build_layers(properties._replace(**start, cone=1.2 * ASSUMED_FRICTION_CONE), plates)
    began = time.perf_counter()
    fit = identify(
        model,
        pressing.place_on_model(recording, model),
        CONTACT_PARAMETERS,
        use=("force",),
        warm_start=True,
        model_errors=SAME_SIMULATOR,
        exact_bench=True,
    )
    facts = {"offset": list(truth.offset), "turn": list(truth.turn), "misfit": fit.fit["force_rms_after"]}
    return {
        "fabric": name,
        **facts,
        **extract_estimates(fit, CONTACT_PARAMETERS),
        "seconds": time.perf_counter() - began,
    }


def extract_estimates(fit: Identification, names: tuple[str, ...]) -> dict[str, Any]:
    """Return the estimates of some parameters as plain JSON."""
    out: dict[str, Any] = {}
    for name in names:
        e, i = fit.parameters[name], fit.influences[name]
        out[name] = {
            "value": e.value,
            "std": e.std,
            "ci95": list(e.ci95),
            "identifiable": e.identifiable,
            "statement": i.statement,
            "experiment": i.experiment,
            "tenth_mm": i.displacement_per_10_percent_mm,
        }
    return {"parameters": out, "converged": bool(fit.fit["converged"]), "warnings": fit.warnings}


def estimates_of(cases: Mapping[str, Mapping[str, Any]], name: str, kind: str, parameter: str) -> list[dict[str, Any]]:
    """Return the estimates of one parameter of a fabric from all cases of a kind."""
    return [c["parameters"][parameter] for key, c in cases.items() if key.startswith(f"{name}-{kind}")]
