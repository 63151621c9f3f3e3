"""Title and one sentence for each cause."""

from __future__ import annotations

from ...episodes.world import Hypothesis

GLOSSARY = {
    "air.drag_n": "Air pushes against cloth that moves broadside, by the square of its speed (1.2: a flat plate).",
    "air.drag_t": "Air rubs along cloth that moves edgewise; as a rule too little to be seen.",
    "air.linear": "Something slows the cloth in proportion to its mass and speed.",
    "air.added_mass": "Air that the cloth carries along makes it heavier to shake and no heavier to hold.",
    "air.wind": "The air itself moves, along x or y of the world.",
    "damp.kv": "Stretching is damped: stress grows with the rate of strain.",
    "damp.bend": "Bending is damped: ripples die out sooner than swings.",
    "fric.internal_bend": "Yarns rub when the cloth bends, so that it keeps a part of its last shape.",
    "fric.internal_shear": "Yarns rub when the cloth is sheared.",
    "plast.crease": "Sharp folds stay: the cloth's rest shape follows strong bending.",
    "bend.aniso": "The cloth bends more easily, or less, along the weft than along the warp.",
    "elas.ortho": "The cloth stretches more along the weft than along the warp.",
    "elas.shear": "The cloth shears more easily, or less, than an isotropic sheet.",
    "elas.stiffen": "The cloth becomes stiffer the more it is stretched.",
    "rest.curl": "The cloth at rest is curved along warp or weft, to one of its sides.",
    "rest.shrink": "The cloth is shorter along warp or weft than its pattern says.",
    "rest.skew": "Warp and weft of the cloth at rest are not at right angles.",
    "mass.density": "The cloth is heavier, or lighter, than its data sheet says.",
    "mass.hem": "A heavy line runs along the rim.",
    "mass.seam": "A heavy line runs along the middle of the cloth.",
    "env.gravity_tilt": "The world's vertical is not where gravity points: robot and camera share a base that leans.",
    "grip.slip": "The cloth creeps out of the grippers under a strong pull.",
    "grip.width": "The grippers hold a larger patch than stated.",
    "robot.regrasp": "The grippers hold the cloth elsewhere along its edge than stated.",
    "contact.mu": "Friction on the table is stronger, or weaker, than stated.",
    "contact.aniso": "Friction on the table depends on the direction of sliding.",
    "contact.stick": "Friction on the table is stronger before the cloth slips than while it does.",
    "contact.adhesion": "Cloth that touches the table is pulled to it: a charge, moisture, or fibres that catch.",
    "obs.extrinsic": "The cloud lies so much too far along x, y or z of the world: T_world_camera is off by as much.",
    "obs.rotation": "The cloud is turned about x, y or z of the world, around the cloth, by the right hand.",
    "obs.clock": "Frames were taken later than their stamps say, or earlier where negative.",
    "obs.edge": "The cloud's rim lies farther out than the cloth's: flying pixels, or erosion where negative.",
    "obs.depth_scale": "The camera's depths are too large by a share.",
    "obs.depth_bias": "The camera's depths are too large by a constant.",
}

CAUSE_TITLES = {
    "air.drag_n": "Air drag, normal (C_n)",
    "air.drag_t": "Air drag, tangential (C_t)",
    "air.linear": "Linear damping",
    "air.added_mass": "Added mass of air",
    "air.wind": "Wind",
    "damp.kv": "Viscosity in tension (Kelvin-Voigt)",
    "damp.bend": "Damping of bending",
    "fric.internal_bend": "Internal friction in bending",
    "fric.internal_shear": "Internal friction in shear",
    "plast.crease": "Creases",
    "bend.aniso": "Anisotropy of bending",
    "elas.ortho": "Orthotropy in tension",
    "elas.shear": "Shear stiffness",
    "elas.stiffen": "Stiffening in tension",
    "rest.curl": "Curl at rest",
    "rest.shrink": "Shrinkage",
    "rest.skew": "Skew at rest",
    "mass.density": "Areal density",
    "mass.hem": "Mass of a hem",
    "mass.seam": "Mass of a seam",
    "env.gravity_tilt": "Tilt of gravity",
    "grip.slip": "Slip in the grippers",
    "grip.width": "Width of the grip",
    "robot.regrasp": "Place of the grip",
    "contact.mu": "Friction (mu)",
    "contact.aniso": "Anisotropy of friction",
    "contact.stick": "Static friction",
    "contact.adhesion": "Adhesion to the table",
    "obs.extrinsic": "Camera offset",
    "obs.rotation": "Camera rotation",
    "obs.clock": "Clock offset",
    "obs.edge": "Offset of the rim",
    "obs.depth_scale": "Scale of depth",
    "obs.depth_bias": "Offset of depth",
}

EQUIVALENT_CAUSES = {  # by structure: no episode distinguishes them from a cause that is asked about
    "robot.base": "The robot stands elsewhere than stated: it looks as if the camera did.",
}


def describe(hypothesis: Hypothesis) -> str:
    """Return what a cause is, in one sentence; empty if nobody says so."""
    return hypothesis.description or GLOSSARY.get(hypothesis.effect, "")


def format_catalogue(hypotheses: list[Hypothesis]) -> str:
    """Return all causes as a table in Markdown; axes of one effect share a row."""
    rows = ["| cause | typical | meaning |", "|---|---|---|"]
    first = {h.effect: h for h in reversed(hypotheses)}
    for h in hypotheses:
        if first.get(h.effect) is h:
            unit = "" if h.unit == "-" else f" {h.unit}"
            rows.append(f"| `{h.effect}` | {h.typical:g}{unit} | {describe(h) or 'registered by a user'} |")
    return "\n".join(rows)
