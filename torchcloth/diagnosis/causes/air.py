"""What air and inner losses do."""

from __future__ import annotations

from functools import partial

from ...effects import AbstractEffect, AddedMass, AirDrag, BendingFriction, KelvinVoigt, MassDamping, ShearFriction
from ...episodes.world import Hypothesis, World

DRAG, DENSITY = "air", 1.204  # kg/m^3, at 20 degrees Celsius


def _drag(world: World) -> tuple[float, float, list[float], float]:
    """(C_n, C_t, wind, density) of the air that the world has."""
    effects = dict(world.cloth.effects.items())
    if DRAG not in effects:
        return 0.0, 0.0, [0.0] * 3, DENSITY
    own: AirDrag = effects[DRAG]  # type: ignore[assignment]
    return own.normal.value.item(), own.tangential.value.item(), own.wind.tolist(), own.density


def _with_drag(world: World, normal: float = 0.0, tangential: float = 0.0) -> World:
    n, t, wind, density = _drag(world)
    return world.with_cloth({DRAG: AirDrag(n + normal, density, t + tangential, wind)})


def _with_wind(axis: int, world: World, speed: float) -> World:
    """Where there is no drag yet, a flat plate's comes along: wind acts through it alone."""
    n, t, wind, density = _drag(world)
    wind[axis] += speed
    normal = n if DRAG in dict(world.cloth.effects.items()) else AirDrag.amplitudes["normal"].typical
    return world.with_cloth({DRAG: AirDrag(normal, density, t, wind)})


def _added(name: str, make: type[AbstractEffect], world: World, amplitude: float) -> World:
    return world.with_cloth({name: make(amplitude)})  # type: ignore[call-arg]


def _viscosity(world: World, time: float) -> World:
    own = world.cloth.material
    stiffness = float(own.youngs_modulus.value) * float(own.thickness)  # type: ignore[union-attr,arg-type]
    return world.with_cloth({"viscosity": KelvinVoigt(time * stiffness)})


HYPOTHESES = (
    Hypothesis("air.drag_n", "-", 1.2, lambda w, a: _with_drag(w, normal=a)),
    Hypothesis("air.drag_t", "-", 0.016, lambda w, a: _with_drag(w, tangential=a)),
    Hypothesis("air.linear", "1/s", 2.0, partial(_added, "linear", MassDamping)),
    Hypothesis("air.added_mass", "m", 0.15, partial(_added, "added_mass", AddedMass)),
    Hypothesis("air.wind[x]", "m/s", 0.3, partial(_with_wind, 0), signed=True, implies="air.drag_n"),
    Hypothesis("air.wind[y]", "m/s", 0.3, partial(_with_wind, 1), signed=True, implies="air.drag_n"),
    Hypothesis("damp.kv", "s", 5e-3, _viscosity),
    Hypothesis("fric.internal_bend", "N", 3e-4, partial(_added, "bending_friction", BendingFriction)),
    Hypothesis("fric.internal_shear", "N/m", 1.0, partial(_added, "shear_friction", ShearFriction)),
)
