"""What the fabric may be beyond an isotropic sheet of its stated size and mass."""

from __future__ import annotations

from ...effects import Bending, CreasingBending, Gravity, LineMass, RestShape
from ...episodes.world import Hypothesis, World
from ...errors import InvalidInput
from ...materials import OrthotropicAEP, StiffeningAEP

MOST = 0.9  # share by which one stiffness may fall short of another
YIELD = 30.0  # 1/m, beyond which bent cloth keeps a crease


def moduli(world: World, weft: float = 0.0, shear: float = 0.0, stiffening: float = 0.0) -> World:
    """Shares by which the weft falls short of the warp, and shear exceeds the isotropic value; c of stiffening."""
    own = world.cloth.material
    nu, warp = float(own.poisson_ratio.value), float(own.youngs_modulus.value)  # type: ignore[union-attr,arg-type]
    if isinstance(own, OrthotropicAEP):
        e2, g = float(own.weft_modulus.value), float(own.shear_modulus.value)
        c = float(own.warp_stiffening.value)
    else:
        e2, g = warp, warp / (2 * (1 + nu))
        c = float(own.stiffening.value) if isinstance(own, StiffeningAEP) else 0.0
        if not (weft or shear):  # one modulus, to be fitted on
            return world.with_cloth(material=StiffeningAEP(warp, nu, c + stiffening, thickness=own.thickness))  # type: ignore[union-attr,arg-type]
    e2, g, c = e2 * (1 - weft), g * (1 + shear), c + stiffening
    new = OrthotropicAEP(
        warp,
        e2,
        g,
        nu,
        warp_stiffening=c,
        weft_stiffening=c,
        thickness=own.thickness,  # type: ignore[union-attr,arg-type]
    )
    return world.with_cloth(material=new)


def _bending(world: World, **changes: float) -> World:
    """Further damping [s], curl [1/m], mobility of creases [1/s]; weft stiffness as a share beyond the warp's."""
    own: Bending = world.cloth.effects["bending"]  # type: ignore[assignment]
    number = lambda name: 0.0 if (part := getattr(own, name, None)) is None else float(part.value)  # noqa: E731
    names = ("damping_time", "curl_warp", "curl_weft", "mobility")
    options = {name: number(name) + changes.get(name, 0.0) for name in names}
    kept = {name: value for name, value in options.items() if value}
    ratio = (number("weft_ratio") or 1.0) * (1 + changes.get("weft", 0.0))
    if ratio != 1.0:
        kept |= {"weft_ratio": ratio, "twist_ratio": ratio**0.5}
    if "mobility" in kept:
        kept["yield_curvature"] = YIELD
    kind = CreasingBending if "mobility" in kept else Bending
    new = kind(number("stiffness"), poisson=own.poisson, **kept)  # type: ignore[arg-type]
    return world.with_cloth({"bending": new})


def _rest(world: World, name: str, amount: float) -> World:
    effects = dict(world.cloth.effects.items())
    own: RestShape | None = effects.get("rest_shape")  # type: ignore[assignment]
    values = {n: 0.0 if own is None else float(getattr(own, n).value) for n in ("shrink_warp", "shrink_weft", "skew")}
    values[name] += amount
    return world.with_cloth({"rest_shape": RestShape(**values)})


def _density(world: World, share: float) -> World:
    new = world.with_cloth()
    new.cloth.areal_density.set(new.cloth.areal_density.value.item() * (1 + share))
    return new


def _seam(world: World, mass: float) -> World:
    """Along v, at half the width of the pattern, whatever the mesh: vertices may lie to either side."""
    pattern = world.cloth.mesh.pattern
    if pattern is None:
        raise InvalidInput("mesh", got="no pattern coordinates", expected="a pattern: the seam is along its v")
    low, high = pattern.min((0, 1)), pattern.max((0, 1))
    middle = 0.5 * (low[0] + high[0])
    return world.with_cloth({"seam": LineMass(mass, path=[[middle, low[1]], [middle, high[1]]])})


def _tilt(axis: int, world: World, angle: float) -> World:
    """Gravity leans towards +x (0) or +y (1)."""
    own: Gravity = world.cloth.effects["gravity"]  # type: ignore[assignment]
    tilt = own.tilt.tolist()
    tilt[1 - axis] += angle if axis == 1 else -angle  # about the other axis, by the right hand, with g along -z
    return world.with_cloth({"gravity": Gravity(own.acceleration.tolist(), tilt)})


OF_BENDING = ("damp.bend", "plast.crease", "bend.aniso", "rest.curl")  # effects that change a cloth's bending
OF_MEMBRANE = ("elas.ortho", "elas.shear", "damp.kv", "fric.internal_shear")  # and its stretching
HYPOTHESES = (
    Hypothesis("damp.bend", "s", 0.05, lambda w, a: _bending(w, damping_time=a)),
    Hypothesis("plast.crease", "1/s", 5.0, lambda w, a: _bending(w, mobility=a), needs_fine_mesh=True),
    Hypothesis("bend.aniso", "-", -0.6, lambda w, a: _bending(w, weft=a), signed=True, low=-MOST),
    Hypothesis("elas.ortho", "-", 0.5, lambda w, a: moduli(w, weft=a), signed=True, high=MOST),
    Hypothesis("elas.shear", "-", -0.6, lambda w, a: moduli(w, shear=a), signed=True, low=-MOST),
    Hypothesis("elas.stiffen", "-", 10.0, lambda w, a: moduli(w, stiffening=a), equivalent_parameter="stiffening"),
    Hypothesis("rest.curl[warp]", "1/m", 3.0, lambda w, a: _bending(w, curl_warp=a), signed=True),
    Hypothesis("rest.curl[weft]", "1/m", 3.0, lambda w, a: _bending(w, curl_weft=a), signed=True),
    Hypothesis("rest.shrink[warp]", "-", 0.03, lambda w, a: _rest(w, "shrink_warp", a), signed=True),
    Hypothesis("rest.shrink[weft]", "-", 0.03, lambda w, a: _rest(w, "shrink_weft", a), signed=True),
    Hypothesis("rest.skew", "rad", 0.03, lambda w, a: _rest(w, "skew", a), signed=True),
    Hypothesis("mass.density", "-", 0.08, _density, signed=True, equivalent_parameter="areal_density"),
    Hypothesis("mass.hem", "kg/m", 0.02, lambda w, a: w.with_cloth({"hem": LineMass(a)})),
    Hypothesis("mass.seam", "kg/m", 0.02, _seam),
    Hypothesis("env.gravity_tilt[x]", "rad", 0.01, lambda w, a: _tilt(0, w, a), signed=True),
    Hypothesis("env.gravity_tilt[y]", "rad", 0.01, lambda w, a: _tilt(1, w, a), signed=True),
)
