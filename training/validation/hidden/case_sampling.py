"""A hidden case is a function of a number: family, effects, amplitudes, fabric, motions, noise.

Numbers 0 to 999 are for development: thresholds may be tuned on them. Sealed ones begin at 100 000; a round draws them
from a secret. Twenty numbers in a row hold every family at its share.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..independent.effects import CATALOGUE
from ..independent.sensor import EYE, TARGET
from .effect_map import DRAGGED, FOLDED, OUTSIDE, PAIRS, SINGLES, Partner

DEVELOPMENT, SEALED = 1000, 100_000
HALF, FULL, MORE = 0.5, 1.0, 1.5  # of typical
ROUND = (
    *("null", "null", "hard null", "hard null", "hard null", "hard null"),
    *("single", "single", "single", "single", "single", "single"),
    *("double", "double", "confounded", "confounded", "outside", "outside", "fault", "next experiment"),
)
CONFOUNDED = ("tilt or wind", "base or extrinsic", "mass without forces", "damping or drag")
FAULTS = ("clock jump", "swapped grippers", "wrong unit", "mirrored")
Plan = tuple[str, float, float]  # motion, heading in degrees, speed


@dataclass(frozen=True)
class Size:
    """How large a case is.

    Attributes:
        nodes: vertices along the truth's sides; fit: along those of the recordings' mesh.
        free, table: motions in the air, and with one on a table.
        pad: m, within which the truth holds vertices: five of its edges and beside them one, the roundest of patches.
        pads: m, between which grippers hold; lines of the truth's vertices are moved to where that ends.
    """

    nodes: int
    fit: int
    free: tuple[Plan, ...]
    table: tuple[Plan, ...]
    pad: float
    pads: tuple[float, float] = (0.042, 0.058)


_COMMON: tuple[Plan, ...] = (
    ("swing-fast", 0.0, 1.0),
    ("swing", 90.0, 1.8),
    ("stretch", 0.0, 1.5),
    ("turn", 0.0, 2.0),
    ("hang", 90.0, 2.0),
)
REDUCED = Size(29, 13, (*_COMMON, ("shake", 0.0, 1.5)), (*_COMMON, ("drag-fast", 0.0, 1.0)), 0.0557)
_FAST: Plan = ("swing-fast", 0.0, 1.3)
SMALL = Size(21, 9, (_FAST, ("turn", 0.0, 3.0)), (_FAST, ("drag-fast", 0.0, 1.3)), 0.0785, (0.075, 0.075))
UNSEEN: Plan = ("swing", 45.0, 1.4)  # of no case
LIKE_OTHERS = 0.4  # share of cases on a table with one of the motions that some effects need: those tell nothing, then
START = 0.02  # m, within which nobody puts a sheet down more exactly
CAMERA, ROLL = 0.05, 0.03  # m and rad, standard deviations of where a rig's camera stands and looks, and how level


@dataclass(frozen=True)
class Hidden:
    """An effect by the generator's name."""

    name: str
    amplitude: float
    options: dict[str, float] = field(default_factory=dict)
    share: float = 1.0  # of the typical amplitude


@dataclass(frozen=True)
class Take:
    """One episode."""

    motion: str
    heading: float  # degrees
    speed: float
    own: tuple[Hidden, ...] = ()  # differs from episode to episode
    start: tuple[float, float] = (0.0, 0.0)  # m, by which the sheet and the grippers are beside the usual place


@dataclass(frozen=True)
class Case:
    """What is hidden in which episodes.

    Attributes:
        seed, family, kind: kind says more within a family: "full", "tilt or wind", ...
        size: of meshes.
        effects: hidden in all episodes.
        takes: the episodes, in the order in which they are written.
        fabric: values of the true fabric; said: data sheet's values over them.
        bias, occlusion: of the sensor; diagonals: of the truth's mesh.
        pad: m, that grippers hold.
        forces: measured.
        camera: where it is, of the sensor.
        fault: of the recording, or "".
    """

    seed: int
    family: str
    kind: str
    size: Size
    effects: tuple[Hidden, ...]
    takes: tuple[Take, ...]
    fabric: dict[str, float]
    said: dict[str, float]
    bias: float = 0.35e-3
    occlusion: float = 0.0
    nodes: int = REDUCED.nodes
    diagonals: str = "alternating"
    pad: float = 0.05
    forces: bool = True
    fault: str = ""
    camera: dict[str, Any] = field(default_factory=dict)

    @property
    def sealed(self) -> bool:
        """Never to be tuned on."""
        return self.seed >= SEALED

    def take(self, plan: Plan) -> Take:
        """A further episode of this case with another motion."""
        return Take(*plan, start=_start(self.seed, plan))


def case(seed: int, size: Size = REDUCED) -> Case:
    """The case of a number.

    Raises:
        ValueError: a number that is neither for development nor sealed.
    """
    if not (0 <= seed < DEVELOPMENT or seed >= SEALED):
        raise ValueError(f"seed {seed}: expected 0 to {DEVELOPMENT - 1}, or {SEALED} and more")
    rng = np.random.default_rng([seed, 7])
    family, turn, slot = ROUND[seed % len(ROUND)], seed // len(ROUND), seed % len(ROUND)
    slot -= ROUND.index(family)
    draw = {
        "null": _null,
        "hard null": _hard,
        "single": _single,
        "double": _double,
        "confounded": _confounded,
        "outside": _outside,
        "fault": _fault,
        "next experiment": _next,
    }[family]
    parts = {"kind": "", "effects": (), "plans": _plans(size, rng)} | draw(rng, turn, slot, size)
    regrasp, plans = parts.pop("regrasp", 0.0), _like_others(parts.pop("plans"), seed, size)
    takes = _balanced(tuple(_take(plan, regrasp, rng) for plan in plans), regrasp)
    takes = [replace(take, start=_start(seed, (take.motion, take.heading, take.speed))) for take in takes]
    order = rng.permutation(len(takes))
    given = {"nodes": size.nodes, "fabric": _fabric(rng), "said": _sheet(rng, 0.15)} | parts
    pad = float(np.random.default_rng([seed, 17]).uniform(*size.pads))
    ordered = tuple(takes[k] for k in order)
    return Case(seed, family, size=size, takes=ordered, pad=pad, camera=_camera(seed), **given)


def sealed(secret: int, count: int) -> list[int]:
    """``count`` sealed numbers; every twenty hold the families at their shares, in an order that tells nothing."""
    rng = np.random.default_rng([secret, 11])
    found: list[int] = []
    while len(found) < count:  # as many as asked for, or more: the first are the same
        turn = int(rng.integers(10**9))
        found += [SEALED + turn * len(ROUND) + int(k) for k in rng.permutation(len(ROUND))]
    return found[:count]


def _plans(size: Size, rng: np.random.Generator) -> tuple[Plan, ...]:
    return size.table if rng.random() < 0.5 else size.free


def _like_others(plans: tuple[Plan, ...], seed: int, size: Size) -> tuple[Plan, ...]:
    """Of the usual motions on a table some for others, which would else tell of friction or creases."""
    rng = np.random.default_rng([seed, 23])
    if size != REDUCED or plans != size.table or rng.random() > LIKE_OTHERS:
        return plans
    others = (DRAGGED, FOLDED)[int(rng.integers(2))]
    return (*plans[: len(plans) - len(others)], *others)


def _start(seed: int, plan: Plan) -> tuple[float, float]:
    """Where a sheet is put down: equal places in all episodes would show whatever is off by a millimetre."""
    x, y = np.random.default_rng([seed, 21, zlib.crc32(repr(plan).encode())]).uniform(-START, START, 2)
    return float(x), float(y)


def _camera(seed: int) -> dict[str, Any]:
    """A case's rig: where all cameras stand alike, a false pose can be read off."""
    rng = np.random.default_rng([seed, 19])
    eye, target = (tuple((np.array(p) + CAMERA * rng.standard_normal(3)).tolist()) for p in (EYE, TARGET))
    return {"eye": eye, "target": target, "roll": float(ROLL * rng.standard_normal())}


def _where(size: Size, rng: np.random.Generator, *names: str) -> tuple[Plan, ...]:
    """Motions in which the effects show."""
    partners = [(SINGLES | OUTSIDE)[name] for name in names]
    special = tuple(dict.fromkeys(plan for p in partners for plan in p.shown))
    plans = size.table if any(p.table for p in partners) else _plans(size, rng)
    return (*plans[: len(plans) - len(special)], *special)


def _take(plan: Plan, regrasp: float, rng: np.random.Generator) -> Take:
    """A person repeats no motion exactly."""
    motion, heading, speed = plan
    heading, speed = heading + rng.uniform(-8, 8), speed * rng.uniform(0.95, 1.05)
    shift = rng.uniform(-regrasp, regrasp)
    # the whole sheet lies further along its own width than the robot says
    own = (Hidden("robot.base", shift, {"heading": heading + 90.0}),) if regrasp else ()
    return Take(motion, float(heading), float(speed), own)


def _balanced(takes: tuple[Take, ...], regrasp: float) -> tuple[Take, ...]:
    """Shifts that cancel among episodes of one heading: what all share would be a robot or a camera that is off."""
    alike = np.array([round(take.heading / 90) for take in takes])
    shifts = np.array([take.own[0].amplitude if take.own else 0.0 for take in takes])
    for heading in set(alike.tolist()):
        shifts[alike == heading] -= shifts[alike == heading].mean()
    shifts *= min(1.0, regrasp / max(np.abs(shifts).max(), 1e-12))
    return tuple(
        replace(take, own=tuple(replace(own, amplitude=float(shift)) for own in take.own))
        for take, shift in zip(takes, shifts, strict=True)
    )


def _fabric(rng: np.random.Generator) -> dict[str, float]:
    """Near the generator's: a sheet that is lighter and stiffer wrinkles at the size of any mesh."""
    return {
        "areal_density": 0.25 * float(np.exp(0.1 * rng.standard_normal())),
        "membrane_stiffness": 120.0 * float(np.exp(0.15 * rng.standard_normal())),
        "bending_stiffness": 6e-5 * float(np.exp(0.15 * rng.standard_normal())),
    }


def _sheet(rng: np.random.Generator, spread: float) -> dict[str, float]:
    """The data sheet's values over the true ones; it was weighed to 2 %."""
    factors = {name: float(np.exp(spread * rng.standard_normal())) for name in STIFFNESSES}
    return {**factors, "areal_density": float(np.clip(1 + 0.02 * rng.standard_normal(), 0.96, 1.04))}


STIFFNESSES = ("membrane_stiffness", "bending_stiffness")


def _hide(
    name: str,
    share: float,
    rng: np.random.Generator,
    partners: dict[str, Partner],
    headings: tuple[float, ...] = (0.0, 90.0, 180.0, 270.0),
) -> tuple[Hidden, ...]:
    """An effect at a share of its typical amplitude, and what it needs to be felt."""
    own = partners[name]
    typical = CATALOGUE[name].typical if own.typical is None else own.typical
    options = {"heading": float(rng.choice(headings))} if own.headed else {}
    amplitude = share * typical * int(rng.choice(own.signs))
    return (*(Hidden(n, a) for n, a in own.beside), Hidden(name, amplitude, options, share))


def _null(rng, turn, slot, size):
    exact = {"membrane_stiffness": 1.0, "bending_stiffness": 1.0, "areal_density": 1.0}
    return {"kind": "matched", "said": exact}


def _hard(rng, turn, slot, size):
    """Everything that may be wrong without being a cause."""
    membrane, bending = np.exp(rng.uniform(np.log([0.4, 0.5]), np.log([2.5, 2.0])))
    said = _sheet(rng, 0.0) | {"membrane_stiffness": float(membrane), "bending_stiffness": float(bending)}
    name = str(rng.choice([n for n in SINGLES if not SINGLES[n].beside]))
    small = _hide(name, float(rng.uniform(0.05, 0.2)), rng, SINGLES)
    mesh = {"diagonals": str(rng.choice(["alternating", "parallel"]))}
    trouble = {"bias": 0.7e-3, "occlusion": 0.2, "regrasp": 4e-3}
    found = {"effects": small, "said": said, "plans": _where(size, rng, name)}
    return {"kind": f"{name} too small to matter", **found, **mesh, **trouble}


def _single(rng, turn, slot, size):
    """Twelve numbers in a row of a family run through the amplitudes; effects through the catalogue."""
    share = (HALF, FULL, MORE)[slot % 3]
    name = list(SINGLES)[(6 * turn + slot + turn // len(SINGLES)) % len(SINGLES)]
    return {"kind": f"{share:g}", "effects": _hide(name, share, rng, SINGLES), "plans": _where(size, rng, name)}


def _double(rng, turn, slot, size):
    pair = PAIRS[(2 * turn + slot) % len(PAIRS)]
    effects = tuple(h for name in pair for h in _hide(name, FULL, rng, SINGLES))
    return {"kind": "two", "effects": effects, "plans": _where(size, rng, *pair)}


def _confounded(rng, turn, slot, size):
    kind = CONFOUNDED[(2 * turn + slot) % len(CONFOUNDED)]
    fast = size == SMALL
    if kind == "tilt or wind":
        found = _hanging(rng)
    elif kind == "base or extrinsic":
        name = str(rng.choice(["robot.base", "obs.extrinsic"]))
        found = {"effects": _hide(name, MORE, rng, SINGLES), "plans": size.free}
    elif kind == "mass without forces":
        found = {"effects": _hide("mass.density", MORE, rng, SINGLES), "plans": size.free, "forces": False}
    else:  # one speed: what grows with it and what grows with its square look alike
        name = str(rng.choice(["air.linear", "air.drag_n"]))
        same = (("swing", 0.0, 1.8), ("swing-fast", 0.0, 0.5), ("swing", 0.0, 1.8))
        found = {"effects": _hide(name, HALF, rng, SINGLES), "plans": same[: 2 if fast else 3]}
    return {"kind": kind, **found}


def _outside(rng, turn, slot, size):
    name = list(OUTSIDE)[(2 * turn + slot) % len(OUTSIDE)]
    share = FULL if rng.random() < 0.5 else MORE
    along = (0.0, 180.0)  # a jet along y would pass beside the sheets, which hang half a metre out along x
    return {"kind": f"{share:g}", "effects": _hide(name, share, rng, OUTSIDE, along), "plans": _where(size, rng, name)}


def _fault(rng, turn, slot, size):
    kind = FAULTS[turn % len(FAULTS)]
    return {"kind": kind, "fault": kind}


def _next(rng, turn, slot, size):
    """As confounded; what is proposed is then done."""
    return {"kind": "tilt or wind", **_hanging(rng)}


def _hanging(rng):
    """Across a sheet that hangs still, wind pushes as gravity does that leans."""
    name = str(rng.choice(["env.gravity_tilt", "air.wind"]))
    still = (("hang", 0.0, 1.0), ("drape", 0.0, 1.0), ("hang", 0.0, 1.4))
    return {"effects": _hide(name, MORE, rng, SINGLES, (0.0, 180.0)), "plans": still}
