"""Small sheets and short runs for the tests of the force terms."""

from dataclasses import replace

import numpy as np

from torchcloth.training.validation.independent.flex_sheet import SheetSpec, sheet_mesh
from torchcloth.training.validation.independent.mujoco_cloth import Grip, MujocoCloth

SMALL_SHEET = SheetSpec(0.2, 0.2, nodes=(7, 7))
WEIGHTLESS_SHEET = replace(SMALL_SHEET, gravity=0.0)


def flat_positions(spec):
    uv, _ = sheet_mesh(spec)
    return np.column_stack([uv, np.zeros(len(uv))])


def vertical_positions(spec):
    uv, _ = sheet_mesh(spec)
    return np.column_stack([np.zeros(len(uv)), uv])


def reset_term(term, spec=SMALL_SHEET, x=None, dt=1e-4):
    cloth = MujocoCloth(spec, dt, [term])
    term.reset(cloth, flat_positions(spec) if x is None else x)
    return term, cloth


def run(spec, terms, seconds, x0=None, v0=None, grips=None, dt=3e-4, frames=2, damping_rate=0.0):
    cloth = MujocoCloth(spec, dt, terms)
    x0 = flat_positions(spec) if x0 is None else x0
    return cloth.run(x0, np.linspace(0, seconds, frames), grips or {}, v0=v0, damping_rate=damping_rate), cloth


def top_grip(spec, x0, slip=None):
    vertices = np.flatnonzero(sheet_mesh(spec)[0][:, 1] > spec.height - 1e-9)
    return {"top": Grip(vertices, np.array([0.0, 1.0]), np.tile(np.eye(4), (2, 1, 1)), slip)}


def crumpled_state(spec, seed=0):
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    x = flat_positions(spec) @ turn
    return x + 4e-3 * rng.standard_normal(x.shape), rng.standard_normal(x.shape)
