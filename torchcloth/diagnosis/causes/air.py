"""Causes in the air, and internal losses of the fabric."""

from __future__ import annotations

from functools import partial

from ..._utils.constants import STANDARD_AIR_DENSITY_KG_PER_M3
from ...effects import AddedMass, AirDrag, BendingFriction, KelvinVoigt, MassDamping, ShearFriction
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
    return world.with_cloth(
        {DRAG_EFFECT_NAME: AirDrag(n + normal, density=density, tangential=t + tangential, wind=wind)}
    )


def _add_wind(axis: int, world: World, speed: float) -> World:
    """Add wind, and a flat plate's drag if the world has none: wind acts through drag alone."""
    n, t, wind, density = _drag(world)
    wind[axis] += speed
    normal = n if DRAG_EFFECT_NAME in dict(world.cloth.effects.items()) else AirDrag.amplitudes["normal"].typical
    return world.with_cloth({DRAG_EFFECT_NAME: AirDrag(normal, density=density, tangential=t, wind=wind)})


def _add_viscosity(world: World, time: float) -> World:
    material = world.cloth.material
    stiffness = float(material.youngs_modulus.value) * float(material.thickness)  # type: ignore[union-attr,arg-type]
    return world.with_cloth({"viscosity": KelvinVoigt(time * stiffness)})


HYPOTHESES = (
    Hypothesis.from_amplitude(AirDrag, "normal", lambda w, a: _add_drag(w, normal=a), effect_name=DRAG_EFFECT_NAME),
    Hypothesis.from_amplitude(
        AirDrag, "tangential", lambda w, a: _add_drag(w, tangential=a), effect_name=DRAG_EFFECT_NAME
    ),
    Hypothesis.from_amplitude(MassDamping),
    Hypothesis.from_amplitude(AddedMass),
    *(
        Hypothesis.from_amplitude(
            AirDrag, "wind", partial(_add_wind, k), axis=axis, effect_name=DRAG_EFFECT_NAME, implies="air.drag_n"
        )
        for k, axis in enumerate("xy")
    ),
    Hypothesis(
        "damp.kv",
        "s",
        5e-3,
        _add_viscosity,
        title="Viscosity in tension (Kelvin-Voigt)",
        description="Stretching is damped: stress grows with the rate of strain.",
        effect_names=("viscosity",),
    ),
    Hypothesis.from_amplitude(BendingFriction, effect_name="bending_friction"),
    Hypothesis.from_amplitude(ShearFriction, effect_name="shear_friction"),
)
