"""Causes in the fabric: what it may be beyond an isotropic sheet of its stated size and mass."""

from __future__ import annotations

from functools import partial
from typing import Any

from ...effects import Bending, CreasingBending, Gravity, LineMass, RestShape
from ...episodes.world import Hypothesis, World
from ...errors import InvalidInput
from ...materials import OrthotropicAEP, StiffeningAEP

MAX_STIFFNESS_DEFICIT = 0.9  # fraction by which one stiffness may be smaller than another
CREASE_YIELD_CURVATURE_PER_M = 30.0  # bent cloth keeps a crease beyond this curvature


def change_moduli(world: World, weft: float = 0.0, shear: float = 0.0, stiffening: float = 0.0) -> World:
    """Return a world whose moduli in tension are changed.

    Args:
        world: the world to change.
        weft: fraction by which the weft modulus is smaller than now.
        shear: fraction by which the shear modulus is larger than now.
        stiffening: increase of the stiffening coefficient c.
    """
    material = world.cloth.material
    nu, warp = float(material.poisson_ratio.value), float(material.youngs_modulus.value)  # type: ignore[union-attr,arg-type]
    between_layers: dict[str, Any] = {
        name: float(getattr(material, name).value) for name in material.contact_parameters
    }
    if isinstance(material, OrthotropicAEP):
        e2, g = float(material.weft_modulus.value), float(material.shear_modulus.value)
        c = float(material.warp_stiffening.value)
    else:
        e2, g = warp, warp / (2 * (1 + nu))
        c = float(material.stiffening.value) if isinstance(material, StiffeningAEP) else 0.0
        if not (weft or shear):  # one modulus, which stays a parameter of fits
            thickness: float = material.thickness  # type: ignore[assignment]
            new = StiffeningAEP(warp, nu, stiffening=c + stiffening, thickness=thickness, **between_layers)
            return world.with_cloth(material=new)
    e2, g, c = e2 * (1 - weft), g * (1 + shear), c + stiffening
    new = OrthotropicAEP(
        warp,
        e2,
        g,
        nu,
        warp_stiffening=c,
        weft_stiffening=c,
        thickness=material.thickness,  # type: ignore[union-attr,arg-type]
        **between_layers,
    )
    return world.with_cloth(material=new)


def _change_bending(world: World, **changes: float) -> World:
    """Add damping [s], curl [1/m], mobility of creases [1/s] and a fraction of weft stiffness."""
    bending: Bending = world.cloth.effects["bending"]  # type: ignore[assignment]

    def number(name: str) -> float:
        return 0.0 if (parameter := getattr(bending, name, None)) is None else float(parameter.value)

    names = ("damping_time", "curl_warp", "curl_weft", "mobility")
    sums = {name: number(name) + changes.get(name, 0.0) for name in names}
    options = {name: value for name, value in sums.items() if value}
    ratio = (number("weft_ratio") or 1.0) * (1 + changes.get("weft", 0.0))
    if ratio != 1.0:
        options |= {"weft_ratio": ratio, "twist_ratio": ratio**0.5}
    if "mobility" in options:
        options["yield_curvature"] = CREASE_YIELD_CURVATURE_PER_M
    kind = CreasingBending if "mobility" in options else Bending
    new = kind(number("stiffness"), poisson=bending.poisson, **options)  # type: ignore[arg-type]
    return world.with_cloth({"bending": new})


def _add_curl(axis: str, world: World, curvature: float) -> World:
    return _change_bending(world, **{f"curl_{axis}": curvature})


def _change_rest_shape(name: str, world: World, amount: float) -> World:
    effects = dict(world.cloth.effects.items())
    rest_shape: RestShape | None = effects.get("rest_shape")  # type: ignore[assignment]
    values = {
        n: 0.0 if rest_shape is None else float(getattr(rest_shape, n).value)
        for n in ("shrink_warp", "shrink_weft", "skew")
    }
    values[name] += amount
    return world.with_cloth({"rest_shape": RestShape(**values)})


def _change_density(world: World, fraction: float) -> World:
    new = world.with_cloth()
    new.cloth.areal_density.set(new.cloth.areal_density.value.item() * (1 + fraction))
    return new


def _add_seam(world: World, mass: float) -> World:
    """Add a seam along v at half the width of the pattern; it need not pass through vertices."""
    pattern = world.cloth.mesh.pattern
    if pattern is None:
        raise InvalidInput("mesh", got="no pattern coordinates", expected="a pattern: the seam is along its v")
    low, high = pattern.min((0, 1)), pattern.max((0, 1))
    middle = 0.5 * (low[0] + high[0])
    return world.with_cloth({"seam": LineMass(mass, path=[[middle, low[1]], [middle, high[1]]])})


def _tilt_gravity(axis: int, world: World, angle: float) -> World:
    """Tilt gravity towards +x (0) or +y (1)."""
    gravity: Gravity = world.cloth.effects["gravity"]  # type: ignore[assignment]
    tilt = gravity.tilt.tolist()
    tilt[1 - axis] += angle if axis == 1 else -angle  # right-handed about the other axis, with g along -z
    return world.with_cloth({"gravity": Gravity(gravity.acceleration.tolist(), tilt)})


PATTERN_AXES = ("warp", "weft")
BENDING_EFFECTS = ("damp.bend", "plast.crease", "bend.aniso", "rest.curl")  # change a cloth's bending
MEMBRANE_EFFECTS = ("elas.ortho", "elas.shear", "damp.kv", "fric.internal_shear")  # change its stretching
HYPOTHESES = (
    Hypothesis.from_amplitude(
        Bending, "damping_time", lambda w, a: _change_bending(w, damping_time=a), effect_name="bending"
    ),
    Hypothesis.from_amplitude(
        CreasingBending,
        "mobility",
        lambda w, a: _change_bending(w, mobility=a),
        effect_name="bending",
        needs_fine_mesh=True,
    ),
    Hypothesis(
        "bend.aniso",
        "-",
        -0.6,
        lambda w, a: _change_bending(w, weft=a),
        signed=True,
        min_amplitude=-MAX_STIFFNESS_DEFICIT,
        title="Anisotropy of bending",
        description="The cloth bends more easily, or less, along the weft than along the warp.",
        effect_names=("bending",),
    ),
    Hypothesis(
        "elas.ortho",
        "-",
        0.5,
        lambda w, a: change_moduli(w, weft=a),
        signed=True,
        max_amplitude=MAX_STIFFNESS_DEFICIT,
        title="Orthotropy in tension",
        description="The cloth stretches more along the weft than along the warp.",
    ),
    Hypothesis(
        "elas.shear",
        "-",
        -0.6,
        lambda w, a: change_moduli(w, shear=a),
        signed=True,
        min_amplitude=-MAX_STIFFNESS_DEFICIT,
        title="Shear stiffness",
        description="The cloth shears more easily, or less, than an isotropic sheet.",
    ),
    Hypothesis(
        "elas.stiffen",
        "-",
        10.0,
        lambda w, a: change_moduli(w, stiffening=a),
        equivalent_parameter="stiffening",
        title="Stiffening in tension",
        description="The cloth becomes stiffer the more it is stretched.",
    ),
    *(
        Hypothesis.from_amplitude(
            Bending,
            f"curl_{axis}",
            partial(_add_curl, axis),
            axis=axis,
            effect_name="bending",
        )
        for axis in PATTERN_AXES
    ),
    *(
        Hypothesis.from_amplitude(
            RestShape,
            f"shrink_{axis}",
            partial(_change_rest_shape, f"shrink_{axis}"),
            axis=axis,
            effect_name="rest_shape",
        )
        for axis in PATTERN_AXES
    ),
    Hypothesis.from_amplitude(RestShape, "skew", partial(_change_rest_shape, "skew"), effect_name="rest_shape"),
    Hypothesis(
        "mass.density",
        "-",
        0.08,
        _change_density,
        signed=True,
        equivalent_parameter="areal_density",
        title="Areal density",
        description="The cloth is heavier, or lighter, than its data sheet says.",
    ),
    Hypothesis.from_amplitude(LineMass),
    Hypothesis.from_amplitude(
        LineMass,
        apply=_add_seam,
        name="mass.seam",
        title="Mass of a seam",
        description="A heavy line runs along the middle of the cloth.",
    ),
    *(
        Hypothesis.from_amplitude(Gravity, "tilt", partial(_tilt_gravity, k), axis=axis, effect_name="gravity")
        for k, axis in enumerate("xy")
    ),
)
