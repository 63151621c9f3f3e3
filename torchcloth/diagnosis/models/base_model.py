"""What a diagnosis starts from: A-EP and bending at the data sheet's values, gravity, grasps, table; no air."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch

from ...cloth import Cloth
from ...episodes.observed import build_cloth
from ...episodes.world import Model, Parameter, World
from ...parameters import PhysicalParameter
from ...recordings import Recording
from ..causes.fabric import moduli

LEAST = 1e-3  # -, of Poisson's ratio
WRONG_BY = 2.5  # factor that a data sheet may be wrong by: two standard deviations
ANY, SILENT = 10.0, 1.0  # likewise, of what it does not say, and the standard deviation from which it has not
POISSON, SPREAD, MOST = 0.05, 0.1, 0.45  # step, standard deviation and largest value of Poisson's ratio
LAW, STIFFER = 1.5, 2.0  # standard deviation and step of stiffening in tension: laws of one modulus differ by as much


def base_model(recording: Recording) -> Model:
    """From what an episode says of its cloth."""
    cloth = build_cloth(replace(recording, air_density=None)).requires_grad_(False)
    return Model(World(cloth), (found := tuple(_parameters(cloth, recording))), torch.zeros(len(found)).double())


def _parameters(cloth: Cloth, recording: Recording) -> list[Parameter]:
    spread = 0.5 * math.log(WRONG_BY)
    told = {"membrane_stiffness", "youngs_modulus"} & set(recording.cloth.nominal)
    found = [_log(cloth, "material.youngs_modulus", 0.1, spread if told else 0.5 * math.log(ANY))]
    nu = float(cloth.material.poisson_ratio.value)  # type: ignore[attr-defined,union-attr]
    ratio = _of(cloth, "material.poisson_ratio", POISSON, SPREAD, lambda c: min(max(nu + c, LEAST), MOST + POISSON))
    found.append(replace(ratio, low=LEAST - nu, high=max(MOST - nu, 0.0)))
    if "bending" in cloth.effects:
        found.append(_log(cloth, "effects.bending.stiffness", 0.2, spread))
    std = recording.cloth.areal_density_std
    if std:
        found.append(_log(cloth, "areal_density", 0.04, std / recording.cloth.areal_density))
    if cloth.mesh.pattern is not None:
        stiffer = lambda world, c: moduli(world, stiffening=c) if c else world  # noqa: E731
        found.append(Parameter("stiffening", "-", STIFFER, LAW, stiffer, lambda c: c, low=0.0))
    return found


def _log(cloth: Cloth, path: str, step: float, std: float) -> Parameter:
    start = float(_part(cloth, path).value)
    return _of(cloth, path, step, std, lambda c: start * math.exp(c))


def _of(cloth: Cloth, path: str, step: float, std: float, value: Callable[[float], float]) -> Parameter:
    head, _, tail = path.partition(".")
    name = tail if head in ("material", "effects") else path

    def apply(world: World, coordinate: float) -> World:
        _part(world.cloth, path).set(value(coordinate))
        return world

    return Parameter(name, _part(cloth, path).unit, step, std, apply, value)


def _part(cloth: Cloth, path: str) -> PhysicalParameter:
    return cloth.get_submodule(path)  # type: ignore[return-value]
