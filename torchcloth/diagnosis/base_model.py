"""What a diagnosis starts from: A-EP and bending at the data sheet's values, gravity, grasps, table; no air."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch

from ..cloth import Cloth
from ..errors import InvalidInput
from ..identification.episodes import cloth_from
from ..parameters import PhysicalParameter
from ..recordings import Collider, Recording
from .world import Model, Parameter, World

LEAST = 1e-3  # -, of Poisson's ratio
INSIDE = 0.02  # m, that noise and a table's place may explain
ALIKE, UPRIGHT = 0.005, 0.9999  # m, and cosine (0.8 degrees): a table that was measured twice
WRONG_BY = 2.5  # factor that a data sheet may be wrong by: two standard deviations
POISSON, SPREAD, MOST = 0.05, 0.1, 0.45  # step, standard deviation and largest value of Poisson's ratio


def together(recordings: Sequence[Recording]) -> Recording:
    """The first episode with the tables of all: an episode may lack one that its cloth never comes near.

    Raises:
        InvalidInput: a table that stands elsewhere in another episode, or in which another's cloth was seen.
    """
    tables: dict[str, Collider] = {}
    for name, table in (named for r in recordings for named in r.colliders.items()):
        if not _same(first := tables.setdefault(name, table), table):
            raise InvalidInput(
                f"table {name!r}",
                got=f"{_described(first)} in one episode, {_described(table)} in another",
                expected="one scene",
                remedy="diagnose the episodes of each scene apart, or name what differs apart",
            )
    for r in recordings:
        for name, table in tables.items():
            depth = 0.0 if name in r.colliders or r.points is None else _depth(r.points.xyz, table)
            if depth > INSIDE:
                raise InvalidInput(
                    "episodes",
                    got=f"cloth {depth:.3f} m inside {name!r}, which only other episodes have",
                    expected="one scene",
                    remedy="diagnose episodes with and without it apart, or name it in every episode.json",
                )
    return replace(recordings[0], colliders=tables)


def _same(a: Collider, b: Collider) -> bool:
    """One plane, up to how well a table is measured, of one friction."""
    away = abs(float((b.point - a.point) @ a.normal))
    return away < ALIKE and float(a.normal @ b.normal) > UPRIGHT and a.friction == b.friction


def _described(table: Collider) -> str:
    point, normal = (" ".join(f"{x:.3g}" for x in v) for v in (table.point, table.normal))
    return f"({point}) m, normal ({normal}), friction {table.friction}"


def _depth(points: np.ndarray, table: Collider) -> float:
    """m, by which the deepest hundredth of the points lies inside."""
    return -float(np.quantile((points - table.point) @ table.normal, 0.01))


def base_model(recording: Recording) -> Model:
    """From what an episode says of its cloth."""
    cloth = cloth_from(replace(recording, air_density=None)).requires_grad_(False)
    return Model(World(cloth), (found := tuple(_parameters(cloth, recording))), torch.zeros(len(found)).double())


def _parameters(cloth: Cloth, recording: Recording) -> list[Parameter]:
    spread = 0.5 * math.log(WRONG_BY)
    found = [_log(cloth, "material.youngs_modulus", 0.1, spread)]
    nu = float(cloth.material.poisson_ratio.value)  # type: ignore[attr-defined,union-attr]
    ratio = _of(cloth, "material.poisson_ratio", POISSON, SPREAD, lambda c: min(max(nu + c, LEAST), MOST + POISSON))
    found.append(replace(ratio, low=LEAST - nu, high=max(MOST - nu, 0.0)))
    if "bending" in cloth.effects:
        found.append(_log(cloth, "effects.bending.stiffness", 0.2, spread))
    std = recording.cloth.areal_density_std
    if std:
        found.append(_log(cloth, "areal_density", 0.04, std / recording.cloth.areal_density))
    return found


def _log(cloth: Cloth, path: str, step: float, std: float) -> Parameter:
    start = float(_part(cloth, path).value)
    return _of(cloth, path, step, std, lambda c: start * math.exp(c))


def _of(cloth: Cloth, path: str, step: float, std: float, value: Callable[[float], float]) -> Parameter:
    head, _, tail = path.partition(".")
    name = tail if head in ("material", "effects") else path
    return Parameter(name, _part(cloth, path).unit, step, std, lambda c, x: _part(c, path).set(value(x)), value)


def _part(cloth: Cloth, path: str) -> PhysicalParameter:
    return cloth.get_submodule(path)  # type: ignore[return-value]
