"""Small sheets and short runs for the tests of the hooks."""

from dataclasses import replace

import numpy as np

from torchcloth.training.validation.independent.flex_sheet import SheetSpec, grid
from torchcloth.training.validation.independent.mujoco_cloth import Grip, MujocoCloth

SMALL = SheetSpec(0.2, 0.2, nodes=(7, 7))
FREE = replace(SMALL, gravity=0.0)
G = 9.81


def lying(spec):
    uv, _ = grid(spec)
    return np.column_stack([uv, np.zeros(len(uv))])


def standing(spec):
    uv, _ = grid(spec)
    return np.column_stack([np.zeros(len(uv)), uv])


def started(hook, spec=SMALL, x=None, dt=1e-4):
    cloth = MujocoCloth(spec, dt, [hook])
    hook.start(cloth, lying(spec) if x is None else x)
    return hook, cloth


def run(spec, hooks, seconds, x0=None, v0=None, grips=None, dt=3e-4, frames=2, brake=0.0):
    cloth = MujocoCloth(spec, dt, hooks)
    x0 = lying(spec) if x0 is None else x0
    return cloth.run(x0, np.linspace(0, seconds, frames), grips or {}, v0=v0, brake=brake), cloth


def top(spec, x0, slip=None):
    held = np.flatnonzero(grid(spec)[0][:, 1] > spec.height - 1e-9)
    return {"top": Grip(held, np.array([0.0, 1.0]), np.tile(np.eye(4), (2, 1, 1)), slip)}


def crumpled(spec, seed=0):
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    x = lying(spec) @ turn
    return x + 4e-3 * rng.standard_normal(x.shape), rng.standard_normal(x.shape)
