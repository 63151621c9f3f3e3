"""Catalogue of the effects that can be hidden in a scene. Amplitude 0 changes nothing, bit by bit.

Names are those of the library's catalogue of causes. Names that begin with ``x.`` are outside it: a diagnosis can only
say that something is unexplained.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from torchcloth.errors import InvalidInput

from .scene import Scene


@dataclass(frozen=True)
class Effect:
    """One effect, as a field of the scene.

    Attributes:
        part: part of the scene.
        field: field of that part that holds the amplitude.
        unit: SI.
        typical: an amplitude that real recordings have.
        motion: a motion in which the effect is visible.
        options: further fields of the part that may be set.
    """

    part: str
    field: str
    unit: str
    typical: float
    motion: str = "swing"
    options: tuple[str, ...] = ()


CATALOGUE = {
    "air.drag_n": Effect("air", "normal", "-", 1.2, "swing-fast"),
    "air.drag_t": Effect("air", "tangential", "-", 0.016, "swing-fast"),
    "air.linear": Effect("air", "linear", "1/s", 2.0),
    "air.added_mass": Effect("air", "added_depth", "m", 0.15),
    "air.wind": Effect("air", "wind", "m/s", 0.3, "hang", ("heading",)),
    "damp.kv": Effect("membrane", "viscosity", "s", 5e-3, "shake"),
    "damp.bend": Effect("plate", "damping_time", "s", 0.05),
    "fric.internal_bend": Effect("plate", "friction", "N", 3e-4, "swing", ("threshold",)),
    "fric.internal_shear": Effect("membrane", "friction", "N/m", 1.0, "stretch", ("threshold",)),
    "bend.B": Effect("plate", "stiffness", "N m", 4e-5),
    "bend.aniso": Effect("plate", "weft", "-", -0.6),
    "elas.ortho": Effect("membrane", "weft", "-", 0.5, "stretch"),
    "elas.shear": Effect("membrane", "shear", "-", -0.6, "stretch"),
    "elas.stiffen": Effect("membrane", "stiffening", "-", 10.0, "stretch"),
    "plast.crease": Effect("plate", "crease", "1/s", 5.0, "fold-open", ("crease_yield",)),
    "rest.curl": Effect("plate", "curl", "1/m", 3.0, "hang", ("curl_weft",)),
    "rest.shrink": Effect("sheet", "shrink_v", "-", 0.03, "hang"),
    "rest.shrink_u": Effect("sheet", "shrink_u", "-", 0.03, "hang"),
    "rest.skew": Effect("sheet", "skew", "rad", 0.03, "hang"),
    "mass.density": Effect("mass", "density", "-", 0.08, "stretch"),
    "mass.hem": Effect("mass", "hem", "kg/m", 0.02),
    "mass.seam": Effect("mass", "seam", "kg/m", 0.02),
    "grip.slip": Effect("grip", "slip", "m/(s N)", 0.05, "stretch", ("slip_threshold",)),
    "grip.width": Effect("grip", "extra_radius", "m", 0.02, "turn"),
    "contact.mu": Effect("table", "friction", "-", 0.2, "drag"),
    "contact.aniso": Effect("table", "anisotropy", "-", -0.5, "drag"),
    "contact.stick": Effect("table", "static_excess", "-", 0.3, "drag", ("speed",)),
    "contact.adhesion": Effect("table", "adhesion", "Pa", 1.5, "lift", ("gap",)),
    "env.gravity_tilt": Effect("mass", "tilt", "rad", 0.01, "hang", ("heading",)),
    "obs.extrinsic": Effect("sensor", "shift", "m", 4e-3, "hang", ("heading", "rotation")),
    "obs.rotation": Effect("sensor", "lean", "rad", 0.02, "hang", ("heading",)),
    "obs.depth_scale": Effect("sensor", "scale", "-", 0.015, "hang"),
    "obs.depth_bias": Effect("sensor", "offset", "m", 5e-3, "hang"),
    "obs.clock": Effect("sensor", "delay", "s", 0.03, "swing-fast"),
    "obs.edge": Effect("sensor", "edge", "m", 8e-3, "hang"),
    "obs.occlusion": Effect("sensor", "occlusion", "-", 0.3),
    "obs.bias": Effect("sensor", "bias", "m", 0.7e-3, "hang", ("bias_memory",)),
    "robot.base": Effect("grip", "base", "m", 2e-3, "hang", ("heading", "yaw")),
    "robot.regrasp": Effect("grip", "regrasp", "m", 0.017, "hang"),
    "x.backlash": Effect("grip", "backlash", "m", 6e-3),
    "x.jet": Effect("air", "jet", "m/s", 1.0, "hang", ("heading", "jet_width", "jet_across", "jet_height")),
    "x.layer_mass": Effect("mass", "layer", "-", 1.0),
    "x.layer_stiffness": Effect("plate", "layer", "-", 7.0),
    "x.moisture": Effect("mass", "moisture", "1/s", 0.05, "stretch"),
}


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
