"""Base model of a diagnosis: A-EP and bending at the data sheet's values, gravity, grasps, table, and no air."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch

from ...cloth import Cloth
from ...episodes.recorded_cloth import build_cloth
from ...episodes.world import BaseParameter, World, WorldModel
from ...parameters import PhysicalParameter
from ...recordings import Recording
from ..causes.fabric import change_moduli

STATED_VALUE_FACTOR = 2.5  # two prior standard deviations of a value that the data sheet states, as a factor
UNSTATED_VALUE_FACTOR = 10.0  # two prior standard deviations of a value that it does not state, as a factor
UNSTATED_PRIOR_STD = 1.0  # of a logarithm; a larger one belongs to a value that the data sheet does not state
MODULUS_STEP = 0.1  # finite step of the logarithm of Young's modulus
BENDING_STEP = 0.2  # finite step of the logarithm of the bending stiffness
DENSITY_STEP = 0.04  # finite step of the logarithm of the areal density
POISSON_STEP = 0.05  # finite step of Poisson's ratio
POISSON_PRIOR_STD = 0.1
MIN_POISSON_RATIO = 1e-3
MAX_POISSON_RATIO = 0.45
STIFFENING_PRIOR_STD = 1.5  # laws of one modulus differ by as much from measured tension
STIFFENING_STEP = 2.0


def build_base_model(recording: Recording) -> WorldModel:
    """Build the model from what an episode states about its cloth."""
    cloth = build_cloth(replace(recording, air_density=None)).requires_grad_(False)
    parameters = tuple(_list_parameters(cloth, recording))
    return WorldModel(World(cloth), parameters, torch.zeros(len(parameters)).double())


def _list_parameters(cloth: Cloth, recording: Recording) -> list[BaseParameter]:
    stated_std, unstated_std = 0.5 * math.log(STATED_VALUE_FACTOR), 0.5 * math.log(UNSTATED_VALUE_FACTOR)
    is_stated = bool({"membrane_stiffness", "youngs_modulus"} & set(recording.cloth.nominal))
    modulus_std = stated_std if is_stated else unstated_std
    parameters = [_log_parameter(cloth, "material.youngs_modulus", MODULUS_STEP, modulus_std)]
    nu = float(cloth.material.poisson_ratio.value)  # type: ignore[attr-defined,union-attr]

    def poisson_ratio(coordinate: float) -> float:
        return min(max(nu + coordinate, MIN_POISSON_RATIO), MAX_POISSON_RATIO + POISSON_STEP)

    poisson = _parameter(cloth, "material.poisson_ratio", POISSON_STEP, POISSON_PRIOR_STD, poisson_ratio)
    low, high = MIN_POISSON_RATIO - nu, max(MAX_POISSON_RATIO - nu, 0.0)
    parameters.append(replace(poisson, min_coordinate=low, max_coordinate=high))
    if "bending" in cloth.effects:
        parameters.append(_log_parameter(cloth, "effects.bending.stiffness", BENDING_STEP, stated_std))
    std = recording.cloth.areal_density_std
    if std:
        parameters.append(_log_parameter(cloth, "areal_density", DENSITY_STEP, std / recording.cloth.areal_density))
    if cloth.mesh.pattern is not None:

        def stiffen(world: World, coordinate: float) -> World:
            return change_moduli(world, stiffening=coordinate) if coordinate else world

        parameters.append(
            BaseParameter(
                "stiffening", "-", STIFFENING_STEP, STIFFENING_PRIOR_STD, stiffen, lambda c: c, min_coordinate=0.0
            )
        )
    return parameters


def _log_parameter(cloth: Cloth, path: str, step: float, prior_std: float) -> BaseParameter:
    start = float(_find_parameter(cloth, path).value)
    return _parameter(cloth, path, step, prior_std, lambda c: start * math.exp(c))


def _parameter(
    cloth: Cloth, path: str, step: float, prior_std: float, value: Callable[[float], float]
) -> BaseParameter:
    head, _, tail = path.partition(".")
    name = tail if head in ("material", "effects") else path

    def apply(world: World, coordinate: float) -> World:
        _find_parameter(world.cloth, path).set(value(coordinate))
        return world

    return BaseParameter(name, _find_parameter(cloth, path).unit, step, prior_std, apply, value)


def _find_parameter(cloth: Cloth, path: str) -> PhysicalParameter:
    return cloth.get_submodule(path)  # type: ignore[return-value]
