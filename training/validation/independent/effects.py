"""Catalogue of the effects that can be hidden in a scene. Amplitude 0 changes nothing, bit by bit.

Names, units and typical amplitudes are those of the library's catalogue of causes; the physics is not. Names that
begin with ``x.`` are outside it: a diagnosis can only say that something is unexplained.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from torchcloth.diagnosis.causes.catalogue import CATALOGUE as CAUSES
from torchcloth.errors import InvalidInput

from .scene import Scene


@dataclass(frozen=True)
class Effect:
    """One effect, as a field of the scene.

    Attributes:
        part: part of the scene.
        field: field of that part that holds the amplitude.
        motion: a motion in which the effect is visible.
        options: further fields of the part that may be set.
        unit: SI; empty: that of the library's cause of this name.
        typical: an amplitude that real recordings have; nan: that of the library's cause of this name.
    """

    part: str
    field: str
    motion: str = "swing"
    options: tuple[str, ...] = ()
    unit: str = ""
    typical: float = math.nan


_EFFECTS = {
    "air.drag_n": Effect("air", "normal", "swing-fast"),
    "air.drag_t": Effect("air", "tangential", "swing-fast"),
    "air.linear": Effect("air", "linear"),
    "air.added_mass": Effect("air", "added_depth"),
    "air.wind": Effect("air", "wind", "hang", ("heading",)),
    "damp.kv": Effect("membrane", "viscosity", "shake"),
    "damp.bend": Effect("plate", "damping_time"),
    "fric.internal_bend": Effect("plate", "friction", "swing", ("threshold",)),
    "fric.internal_shear": Effect("membrane", "friction", "stretch", ("threshold",)),
    "bend.B": Effect("plate", "stiffness", unit="N m", typical=4e-5),
    "bend.aniso": Effect("plate", "weft"),
    "elas.ortho": Effect("membrane", "weft", "stretch"),
    "elas.shear": Effect("membrane", "shear", "stretch"),
    "elas.stiffen": Effect("membrane", "stiffening", "stretch"),
    "plast.crease": Effect("plate", "crease", "fold-open", ("crease_yield",)),
    "rest.curl": Effect("plate", "curl", "hang", ("curl_weft",)),
    "rest.shrink": Effect("sheet", "shrink_v", "hang"),
    "rest.shrink_u": Effect("sheet", "shrink_u", "hang"),
    "rest.skew": Effect("sheet", "skew", "hang"),
    "mass.density": Effect("mass", "density", "stretch"),
    "mass.hem": Effect("mass", "hem"),
    "mass.seam": Effect("mass", "seam"),
    "grip.slip": Effect("grip", "slip", "stretch", ("slip_threshold",)),
    "grip.width": Effect("grip", "extra_radius", "turn"),
    "contact.mu": Effect("table", "friction", "drag"),
    "contact.aniso": Effect("table", "anisotropy", "drag"),
    "contact.stick": Effect("table", "static_excess", "drag", ("speed",)),
    "contact.adhesion": Effect("table", "adhesion", "lift", ("gap",)),
    "env.gravity_tilt": Effect("mass", "tilt", "hang", ("heading",)),
    "obs.extrinsic": Effect("sensor", "shift", "hang", ("heading", "rotation")),
    "obs.rotation": Effect("sensor", "lean", "hang", ("heading",)),
    "obs.depth_scale": Effect("sensor", "scale", "hang"),
    "obs.depth_bias": Effect("sensor", "offset", "hang"),
    "obs.clock": Effect("sensor", "delay", "swing-fast"),
    "obs.edge": Effect("sensor", "edge", "hang"),
    "obs.occlusion": Effect("sensor", "occlusion", unit="-", typical=0.3),
    "obs.bias": Effect("sensor", "bias", "hang", ("bias_memory",), unit="m", typical=0.7e-3),
    "robot.base": Effect("grip", "base", "hang", ("heading", "yaw"), unit="m", typical=2e-3),
    "robot.regrasp": Effect("grip", "regrasp", "hang"),
    "x.backlash": Effect("grip", "backlash", unit="m", typical=6e-3),
    "x.jet": Effect(
        "air", "jet", "hang", ("heading", "jet_width", "jet_across", "jet_height"), unit="m/s", typical=1.0
    ),
    "x.layer_mass": Effect("mass", "layer", unit="-", typical=1.0),
    "x.layer_stiffness": Effect("plate", "layer", unit="-", typical=7.0),
    "x.moisture": Effect("mass", "moisture", "stretch", unit="1/s", typical=0.05),
}
_CAUSE_OF_EFFECT = {"rest.shrink_u": "rest.shrink"}  # axes have effects of their own here


def _with_size(name: str, effect: Effect) -> Effect:
    """Return the effect with unit and typical amplitude of the library's cause, where it has none of its own."""
    if effect.unit:
        return effect
    cause = next(c for c in CAUSES if c.effect == _CAUSE_OF_EFFECT.get(name, name))
    return replace(effect, unit=cause.unit, typical=cause.typical)


CATALOGUE = {name: _with_size(name, effect) for name, effect in _EFFECTS.items()}


def add_effect(scene: Scene, name: str, amplitude: float, options: dict[str, float] | None = None) -> Scene:
    """Return the scene with an effect added to what it has.

    Raises:
        InvalidInput: no such effect or option.
    """
    if name not in CATALOGUE:
        raise InvalidInput("effect", got=repr(name), expected=f"one of {', '.join(CATALOGUE)}")
    effect = CATALOGUE[name]
    part = getattr(scene, effect.part)
    changed: dict[str, object] = {}
    for key, value in {effect.field: amplitude, **(options or {})}.items():
        if key != effect.field and key not in effect.options:
            raise InvalidInput(f"option of {name}", got=repr(key), expected=", ".join(effect.options) or "none")
        changed[key] = value
    changed[effect.field] = getattr(part, effect.field) + amplitude
    return replace(scene, **{effect.part: replace(part, **changed)})


def parse_effect(text: str) -> tuple[str, float, dict[str, float]]:
    """Parse ``NAME=VALUE[,OPTION=VALUE...]`` into name, amplitude and options.

    Raises:
        InvalidInput: anything else.
    """
    try:
        (name, amplitude), *rest = ((key, float(value)) for key, value in (p.split("=") for p in text.split(",")))
    except ValueError:
        raise InvalidInput("--effect", got=repr(text), expected="NAME=VALUE[,OPTION=VALUE...]") from None
    return name, amplitude, dict(rest)
