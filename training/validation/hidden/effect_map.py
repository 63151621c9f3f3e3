"""Map from hidden effects to the library's causes, and how a round hides each effect.

The names are written out here; a test compares them with the library's catalogue.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class EffectMapping:
    """One effect of the independent engine (its effects.py), as a round uses it.

    Attributes:
        names: causes of the library that are right; empty: the library knows none.
        typical: amplitude, SI; None: the engine's own.
        signs: of the amplitude, of which one is drawn.
        sign: of the library's amplitude over the engine's; 0: they cannot be compared.
        has_heading: the effect has a heading, one of the world's four.
        axis: of the library's amplitude, for effects without a heading.
        needs_table: the effect is visible on a table only.
        required_motions: motion, heading [degrees] and speed, in which the effect is visible; in the usual motions it
            hardly is. The case has them.
        enabling_effects: name and amplitude of effects without which this one has no force; naming them is right, too.
    """

    names: tuple[str, ...]
    typical: float | None = None
    signs: tuple[int, ...] = (1,)
    sign: float = 1.0
    has_heading: bool = False
    axis: str = ""
    needs_table: bool = False
    required_motions: tuple[tuple[str, float, float], ...] = ()
    enabling_effects: tuple[tuple[str, float], ...] = ()


FITTED_FABRIC_VALUES = {
    "youngs_modulus": "membrane_stiffness",
    "bending.stiffness": "bending_stiffness",
    "areal_density": "areal_density",
}  # fitted parameter -> true value of the fabric; Poisson's ratio is 0.3
BOTH_SIGNS = (1, -1)
ENABLING_DRAG = (("air.drag_n", 1.2),)
DRAG_MOTIONS = (
    ("drag", 90.0, 1.0),
    ("drag-fast", 0.0, 1.0),
)  # in one motion alone, friction and density are confounded
# not on a table: the library rotates about the cloth, the truth about one point
SHAKE_MOTIONS = (("shake", 0.0, 1.5),)
# opened again: while the cloth is folded, two engines differ by more than creases
FOLD_MOTIONS = (("fold-open", 0.0, 1.4),)
SINGLE_EFFECTS = {
    "air.drag_n": EffectMapping(("air.drag_n",)),
    "obs.rotation": EffectMapping(("obs.rotation",), has_heading=True, required_motions=SHAKE_MOTIONS),
    "air.linear": EffectMapping(("air.linear",)),
    "air.added_mass": EffectMapping(("air.added_mass",)),
    "air.wind": EffectMapping(("air.wind",), has_heading=True, enabling_effects=ENABLING_DRAG),
    "damp.kv": EffectMapping(("damp.kv",)),
    "damp.bend": EffectMapping(("damp.bend",)),
    "fric.internal_bend": EffectMapping(("fric.internal_bend",)),
    "fric.internal_shear": EffectMapping(("fric.internal_shear",)),
    "bend.aniso": EffectMapping(("bend.aniso",)),
    "elas.ortho": EffectMapping(("elas.ortho",)),
    "elas.shear": EffectMapping(("elas.shear",)),
    "elas.stiffen": EffectMapping(("elas.stiffen",)),
    "rest.curl": EffectMapping(("rest.curl",), signs=BOTH_SIGNS, axis="warp"),
    "rest.shrink": EffectMapping(("rest.shrink",), signs=BOTH_SIGNS, axis="weft"),
    "rest.shrink_u": EffectMapping(("rest.shrink",), signs=BOTH_SIGNS, axis="warp"),
    "rest.skew": EffectMapping(("rest.skew",), signs=BOTH_SIGNS),
    "mass.density": EffectMapping(("mass.density",), signs=BOTH_SIGNS),
    "mass.hem": EffectMapping(("mass.hem",)),
    "mass.seam": EffectMapping(("mass.seam",)),
    "grip.slip": EffectMapping(("grip.slip",)),
    "grip.width": EffectMapping(("grip.width",)),
    "contact.mu": EffectMapping(("contact.mu",), signs=BOTH_SIGNS, needs_table=True, required_motions=DRAG_MOTIONS),
    "env.gravity_tilt": EffectMapping(("env.gravity_tilt",), has_heading=True),
    "obs.extrinsic": EffectMapping(("obs.extrinsic", "robot.base"), has_heading=True),
    "obs.clock": EffectMapping(("obs.clock",), signs=BOTH_SIGNS, sign=-1.0),
    "obs.edge": EffectMapping(("obs.edge",), sign=0.0),
    "robot.base": EffectMapping(("obs.extrinsic", "robot.base"), 4e-3, has_heading=True, sign=-1.0),
    "robot.regrasp": EffectMapping(("robot.regrasp",), signs=BOTH_SIGNS),
    "obs.depth_scale": EffectMapping(("obs.depth_scale",), signs=BOTH_SIGNS),
    "obs.depth_bias": EffectMapping(("obs.depth_bias",), signs=BOTH_SIGNS),
    "contact.aniso": EffectMapping(("contact.aniso",), needs_table=True, required_motions=DRAG_MOTIONS),
    "plast.crease": EffectMapping(("plast.crease",), needs_table=True, required_motions=FOLD_MOTIONS),
}
# effects that no round hides, and why
EXCLUDED_EFFECTS = {
    "air.drag_t": "moves cloth by 0.02 mm, which is not visible",
    "contact.stick": "moves cloth by 0.15 mm, which is not visible",
    "contact.adhesion": "moves visible cloth by 0.2 mm, where it is lifted off a table",
    "obs.occlusion": "no error: it only hides points",
    "obs.bias": "noise",
    "bend.B": "a fitted parameter of the base model",
}
OUTSIDE_EFFECTS = {
    "x.backlash": EffectMapping(()),
    "x.jet": EffectMapping((), has_heading=True, enabling_effects=ENABLING_DRAG),
    "x.layer_mass": EffectMapping(()),
    "x.layer_stiffness": EffectMapping((), 4.0),  # stiffer needs steps too small for a round
    "x.moisture": EffectMapping((), 0.2),
}
# pairs that the usual motions can separate
PAIRED_EFFECTS = (
    ("air.drag_n", "grip.slip"),
    ("air.drag_n", "rest.curl"),
    ("air.drag_n", "obs.clock"),
    ("air.drag_n", "obs.extrinsic"),
    ("env.gravity_tilt", "mass.hem"),
    ("damp.bend", "rest.shrink"),
    ("air.added_mass", "elas.shear"),
    ("air.linear", "rest.skew"),
    ("mass.seam", "elas.ortho"),
    ("air.added_mass", "contact.mu"),
    ("obs.clock", "mass.hem"),
    ("rest.shrink_u", "air.drag_n"),
)
