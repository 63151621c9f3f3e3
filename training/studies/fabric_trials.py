"""The cases of the fabric study: stretching trials, what they say of k and gamma, and presses that show these."""

from __future__ import annotations

import time
from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np

import torchcloth as tc
from torchcloth.identification import Identification, identify
from torchcloth.materials.presets import find_fabric

from ..resumable import Case
from . import pressing, stretching
from .paper_fabrics import FABRICS
from .pressing import Layer, Plates
from .stretching import Detail, Fabric, Pull

DENSITIES = {  # kg/m^2, assumed: the paper gives none
    "cotton": 0.15,
    "artificial_silk": 0.12,
    "wool": 0.25,
    "polyester": 0.15,
    "coated_nylon": 0.30,
}
CONE = 0.3  # assumed: the paper gives no friction of layers
PULLS = (
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
PAIR = ("youngs_modulus", "poisson_ratio")
DIRECTOR = ("contact_stiffness", "shear_stiffness", "cone")
START, START_POISSON = 1.5, 0.2  # E's start over the truth, and the same for all fabrics
HELD = {"grasp": 1e-3}  # m, prior of the clamps' places
SPACING = 0.0125  # m, of the contact's grid


class Scale(NamedTuple):
    """How much of the study is done."""

    fabrics: tuple[str, ...]
    pulls: tuple[Pull, ...]
    detail: Detail
    presses: int  # of each kind
    cells: tuple[int, int]  # along a side of a pressed layer: truth's mesh and model's

    def settings(self) -> dict[str, Any]:
        """What a kept case depends on, besides its name; fabrics and pulls may be added later."""
        return {"detail": list(self.detail), "cells": list(self.cells), "refined": True}


FULL = Scale(tuple(FABRICS), PULLS, Detail(), 3, (6, 4))
FAST = Scale(("cotton", "wool"), (PULLS[3], PULLS[5], PULLS[8]), Detail(0.05, 9, 80), 1, (3, 2))


def fabric(name: str) -> Fabric:
    """A paper's fabric as a sheet."""
    f = find_fabric(name).isotropic()
    return Fabric(f["youngs_modulus"] * f["thickness"], f["poisson_ratio"], DENSITIES[name])


def layer(name: str) -> Layer:
    """A paper's fabric as a pressed layer."""
    return Layer(**find_fabric(name).isotropic(), cone=CONE, density=DENSITIES[name])


def truth(name: str) -> dict[str, float]:
    """By the names of the fit."""
    return {key: value for key, value in layer(name)._asdict().items() if key in (*PAIR, *DIRECTOR)}


def stretches(scale: Scale) -> dict[str, Case]:
    """The stretching trials by name."""
    return {
        f"{name}-pull-{PULLS.index(pull) + 1:02d}": partial(stretch, name, pull, scale.detail)
        for name in scale.fabrics
        for pull in scale.pulls
    }


def others(scale: Scale) -> dict[str, Case]:
    """What the first trial says of k and gamma, and the presses."""
    out: dict[str, Case] = {}
    for name in scale.fabrics:
        out[f"{name}-director"] = partial(director, name, scale)
        for i in range(scale.presses):
            out[f"{name}-press-{i + 1:02d}"] = partial(press, name, i, scale, False)
            out[f"{name}-elsewhere-{i + 1:02d}"] = partial(press, name, i, scale, True)
    return out


def seed_of(name: str, index: int) -> int:
    """Every trial of a kind has noise of its own; the three places elsewhere in the grid are those of all fabrics."""
    return 100 * list(FABRICS).index(name) + index


def stretch(name: str, pull: Pull, detail: Detail) -> dict[str, Any]:
    """One stretching trial, fitted."""
    recording = stretching.record(fabric(name), pull, seed_of(name, PULLS.index(pull)), detail)
    start = fabric(name)._replace(membrane=START * fabric(name).membrane, poisson=START_POISSON)
    model, began = stretching.sheet(recording, start), time.perf_counter()
    fit = identify(model, recording, PAIR, nuisances=HELD, refine=True)
    facts = {"direction": pull.direction, "clamps": pull.clamps, "strain": stretching.strain(fabric(name), pull)}
    return {"fabric": name, **facts, **told(fit, PAIR), "seconds": time.perf_counter() - began}


def director(name: str, scale: Scale) -> dict[str, Any]:
    """What the first trial says of k and gamma: the same data, with contact in the model; it starts at the truth."""
    pull, own = scale.pulls[0], layer(name)
    recording = stretching.record(fabric(name), pull, seed_of(name, 0), scale.detail)
    contact = tc.Contact(spacing=2 * scale.detail.cell)
    model = stretching.sheet(recording, fabric(name), contact, own.contact_stiffness, own.shear_stiffness)
    names = (*PAIR, *DIRECTOR[:2])
    dt = 0.7 * model.stable_step()  # one for all k: another step would move the cloth by its rounding
    fit = identify(model, recording, names, nuisances=HELD, warm_start=True, iterations=1, dt=dt)
    return {"fabric": name, **told(fit, names)}


def press(name: str, index: int, scale: Scale, elsewhere: bool) -> dict[str, Any]:
    """Two layers pressed and slid; ``elsewhere``: the truth's plates are at another place of the contact's grid."""
    own, seed = layer(name), seed_of(name, 50 + index)
    offset = np.random.default_rng(1000 + index).uniform(0, SPACING, 3) * elsewhere
    fine, coarse = scale.cells
    recording = pressing.record(own, Plates(fine + index % 2, SPACING, tuple(offset)), seed)
    start = {"contact_stiffness": START * own.contact_stiffness, "shear_stiffness": own.shear_stiffness / START}
    plates = Plates(coarse, SPACING)
    model = pressing.stack(own._replace(**start, cone=1.2 * CONE), plates)
    began = time.perf_counter()
    fit = identify(model, pressing.on_model(recording, model), DIRECTOR, use=("force",), warm_start=True)
    facts = {"offset": [float(x) for x in offset], "misfit": fit.fit["force_rms_after"]}
    return {"fabric": name, **facts, **told(fit, DIRECTOR), "seconds": time.perf_counter() - began}


def told(fit: Identification, names: tuple[str, ...]) -> dict[str, Any]:
    """What a fit says of some parameters."""
    out: dict[str, Any] = {}
    for name in names:
        e, i = fit.parameters[name], fit.influences[name]
        out[name] = {
            "value": e.value,
            "std": e.std,
            "ci95": list(e.ci95),
            "identifiable": e.identifiable,
            "says": i.statement,
            "experiment": i.experiment,
            "tenth_mm": i.displacement_per_10_percent_mm,
        }
    return {"parameters": out, "converged": bool(fit.fit["converged"]), "warnings": fit.warnings}


def values(cases: Mapping[str, Mapping[str, Any]], name: str, kind: str, parameter: str) -> list[dict[str, Any]]:
    """What all cases of a kind say of one parameter of a fabric."""
    return [c["parameters"][parameter] for key, c in cases.items() if key.startswith(f"{name}-{kind}")]
