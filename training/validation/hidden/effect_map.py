"""What a diagnosis may call each hidden effect, and how strong and where the round hides it.

The truth does not import the library's catalogue: names are compared with it by a test.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Partner:
    """One effect of training/validation/independent/effects.py as the round uses it.

    Attributes:
        names: causes of the library that are right; empty: it knows none.
        typical: amplitude; None: the generator's own.
        signs: drawn from these.
        sign: of the library's amplitude over the generator's; 0: not comparable.
        headed: takes a heading: one of the world's four.
        axis: of the library's amplitude; what is headed has the world's.
        table: shows on a table only.
        shown: motions in which it shows, where the usual ones hardly do: they are among the case's.
        beside: further effects that must be there for this one to be felt; naming them is right, too.
    """

    names: tuple[str, ...]
    typical: float | None = None
    signs: tuple[int, ...] = (1,)
    sign: float = 1.0
    headed: bool = False
    axis: str = ""
    table: bool = False
    shown: tuple[tuple[str, float, float], ...] = ()  # motion, heading in degrees, speed
    beside: tuple[tuple[str, float], ...] = ()


NUMBERS = {
    "youngs_modulus": "membrane_stiffness",
    "bending.stiffness": "bending_stiffness",
    "areal_density": "areal_density",
}  # coordinates of the base model whose truth is a factor of the data sheet's values; Poisson's ratio is 0.3
BOTH = (1, -1)
DRAG = (("air.drag_n", 1.2),)
DRAGGED = (("drag", 90.0, 1.0), ("drag-fast", 0.0, 1.0))  # once, friction hides behind the density
SHAKEN = (("shake", 0.0, 1.5),)  # none on a table: the library turns about the cloth, the truth about one place
FOLDED = (("fold-open", 0.0, 1.4),)  # closed, creases hide behind what two engines fold otherwise
SINGLES = {
    "air.drag_n": Partner(("air.drag_n",)),
    "obs.rotation": Partner(("obs.rotation",), headed=True, shown=SHAKEN),
    "air.linear": Partner(("air.linear",)),
    "air.added_mass": Partner(("air.added_mass",)),
    "air.wind": Partner(("air.wind",), headed=True, beside=DRAG),
    "damp.kv": Partner(("damp.kv",)),
    "damp.bend": Partner(("damp.bend",)),
    "fric.internal_bend": Partner(("fric.internal_bend",)),
    "fric.internal_shear": Partner(("fric.internal_shear",)),
    "bend.aniso": Partner(("bend.aniso",)),
    "elas.ortho": Partner(("elas.ortho",)),
    "elas.shear": Partner(("elas.shear",)),
    "elas.stiffen": Partner(("elas.stiffen",)),
    "rest.curl": Partner(("rest.curl",), signs=BOTH, axis="warp"),
    "rest.shrink": Partner(("rest.shrink",), signs=BOTH, axis="weft"),
    "rest.shrink_u": Partner(("rest.shrink",), signs=BOTH, axis="warp"),
    "rest.skew": Partner(("rest.skew",), signs=BOTH),
    "mass.density": Partner(("mass.density",), signs=BOTH),
    "mass.hem": Partner(("mass.hem",)),
    "mass.seam": Partner(("mass.seam",)),
    "grip.slip": Partner(("grip.slip",)),
    "grip.width": Partner(("grip.width",)),
    "contact.mu": Partner(("contact.mu",), signs=BOTH, table=True, shown=DRAGGED),
    "env.gravity_tilt": Partner(("env.gravity_tilt",), headed=True),
    "obs.extrinsic": Partner(("obs.extrinsic", "robot.base"), headed=True),
    "obs.clock": Partner(("obs.clock",), signs=BOTH, sign=-1.0),
    "obs.edge": Partner(("obs.edge",), sign=0.0),
    "robot.base": Partner(("obs.extrinsic", "robot.base"), 4e-3, headed=True, sign=-1.0),
    "robot.regrasp": Partner(("robot.regrasp",), signs=BOTH),
    "obs.depth_scale": Partner(("obs.depth_scale",), signs=BOTH),
    "obs.depth_bias": Partner(("obs.depth_bias",), signs=BOTH),
    "contact.aniso": Partner(("contact.aniso",), table=True, shown=DRAGGED),
    "plast.crease": Partner(("plast.crease",), table=True, shown=FOLDED),
}
# not hidden, and why
LEFT_OUT = {
    "air.drag_t": "moves cloth by 0.02 mm (docs/validation/independent-engine.md): nobody sees that",
    "contact.stick": "moves cloth by 0.15 mm: likewise",
    "contact.adhesion": "moves what is seen by 0.2 mm, where cloth is lifted off a table",
    "obs.occlusion": "no error: it hides",
    "obs.bias": "noise",
    "bend.B": "a parameter of the base model",
}
OUTSIDE = {
    "x.backlash": Partner(()),
    "x.jet": Partner((), headed=True, beside=DRAG),
    "x.layer_mass": Partner(()),
    "x.layer_stiffness": Partner((), 4.0),  # stiffer needs steps too small for a round
    "x.moisture": Partner((), 0.2),
}
# pairs that the standard motions can tell apart; the second list needs the table
PAIRS = (
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
