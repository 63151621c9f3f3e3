"""Causes in the air, and internal losses of the fabric."""

from __future__ import annotations

from functools import partial

from ..._utils.constants import STANDARD_AIR_DENSITY_KG_PER_M3
from ...effects import AbstractEffect, AddedMass, AirDrag, BendingFriction, KelvinVoigt, MassDamping, ShearFriction
from ...episodes.world import Hypothesis, World

DRAG_EFFECT_NAME = "air"


def _drag(world: World) -> tuple[float, float, list[float], float]:
    """Return (C_n, C_t, wind, density) of the world's air."""
    effects = dict(world.cloth.effects.items())
    if DRAG_EFFECT_NAME not in effects:
        return 0.0, 0.0, [0.0] * 3, STANDARD_AIR_DENSITY_KG_PER_M3
    drag: AirDrag = effects[DRAG_EFFECT_NAME]  # type: ignore[assignment]
    return drag.normal.value.item(), drag.tangential.value.item(), drag.wind.tolist(), drag.density


def _add_drag(world: World, normal: float = 0.0, tangential: float = 0.0) -> World:
    n, t, wind, density = _drag(world)
    return world.with_cloth({DRAG_EFFECT_NAME: AirDrag(n + normal, density, t + tangential, wind)})


def _add_wind(axis: int, world: World, speed: float) -> World:
    """Add wind, and a flat plate's drag if the world has none: wind acts through drag alone."""
    n, t, wind, density = _drag(world)
    wind[axis] += speed
    normal = n if DRAG_EFFECT_NAME in dict(world.cloth.effects.items()) else AirDrag.amplitudes["normal"].typical
    return world.with_cloth({DRAG_EFFECT_NAME: AirDrag(normal, density, t, wind)})


def _add_effect(name: str, make: type[AbstractEffect], world: World, amplitude: float) -> World:
    return world.with_cloth({name: make(amplitude)})  # type: ignore[call-arg]


def _add_viscosity(world: World, time: float) -> World:
    material = world.cloth.material
    stiffness = float(material.youngs_modulus.value) * float(material.thickness)  # type: ignore[union-attr,arg-type]
    return world.with_cloth({"viscosity": KelvinVoigt(time * stiffness)})


HYPOTHESES = (
    Hypothesis("air.drag_n", "-", 1.2, lambda w, a: _add_drag(w, normal=a)),
    Hypothesis("air.drag_t", "-", 0.016, lambda w, a: _add_drag(w, tangential=a)),
    Hypothesis("air.linear", "1/s", 2.0, partial(_add_effect, "linear", MassDamping)),
    Hypothesis("air.added_mass", "m", 0.15, partial(_add_effect, "added_mass", AddedMass)),
    Hypothesis("air.wind[x]", "m/s", 0.3, partial(_add_wind, 0), signed=True, implies="air.drag_n"),
    Hypothesis("air.wind[y]", "m/s", 0.3, partial(_add_wind, 1), signed=True, implies="air.drag_n"),
    Hypothesis("damp.kv", "s", 5e-3, _add_viscosity),
    Hypothesis("fric.internal_bend", "N", 3e-4, partial(_add_effect, "bending_friction", BendingFriction)),
    Hypothesis("fric.internal_shear", "N/m", 1.0, partial(_add_effect, "shear_friction", ShearFriction)),
)
