"""Draw hidden cases. A case is a function of a seed: family, effects, amplitudes, fabric, motions, noise.

Seeds 0 to 999 are for development: thresholds may be tuned on them. Sealed seeds begin at 100 000; a round draws them
from a secret. Twenty seeds in a row hold every family in its proportion.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..independent.effects import CATALOGUE
from ..independent.sensor import EYE_M, TARGET_M
from .effect_map import DRAG_MOTIONS, FOLD_MOTIONS, OUTSIDE_EFFECTS, PAIRED_EFFECTS, SINGLE_EFFECTS, EffectMapping

DEVELOPMENT_SEEDS = 1000  # seeds below
FIRST_SEALED_SEED = 100_000
HALF_SIZE, TYPICAL_SIZE, LARGE_SIZE = 0.5, 1.0, 1.5  # of the typical amplitude
FAMILY_CYCLE = (
    *("null", "null", "hard null", "hard null", "hard null", "hard null"),
    *("single", "single", "single", "single", "single", "single"),
    *("double", "double", "confounded", "confounded", "outside", "outside", "fault", "next experiment"),
)
CONFOUNDED_KINDS = ("tilt or wind", "base or extrinsic", "mass without forces", "damping or drag")
FAULT_KINDS = ("clock jump", "swapped grippers", "wrong unit", "mirrored")
HEADINGS_DEG = (0.0, 90.0, 180.0, 270.0)
FABRIC_STIFFNESSES = ("membrane_stiffness", "bending_stiffness")
# Some effects need special motions. This fraction of the other cases on a table has one of these motions as well, so
# that the motion alone does not reveal the effect.
DECOY_MOTION_FRACTION = 0.4
PLACEMENT_RANGE_M = 0.02  # nobody puts a sheet down more exactly
CAMERA_POSITION_STD_M, CAMERA_ROLL_STD_RAD = 0.05, 0.03  # of a rig's camera: where it stands and looks, how level
HEADING_RANGE_DEG = 8.0  # by which a person misses a heading
SPEED_RANGE = (0.95, 1.05)  # likewise a speed

MotionPlan = tuple[str, float, float]  # motion, heading [degrees], speed factor
Fields = dict[str, Any]  # of a Case


@dataclass(frozen=True)
class CaseSize:
    """Meshes and motions of a case.

    Attributes:
        nodes: vertices along the truth's sides.
        fit_nodes: vertices along the sides of the recordings' mesh.
        hanging: motions of cases without a table.
        table: motions of cases with one motion on a table.
        vertex_radius: m, within which the truth holds vertices: five of its edges and one more, the roundest patch.
        grip_radii: m, range of the grippers' radii. Grid lines of the truth are moved to the edge of the grip.
    """

    nodes: int
    fit_nodes: int
    hanging: tuple[MotionPlan, ...]
    table: tuple[MotionPlan, ...]
    vertex_radius: float
    grip_radii: tuple[float, float] = (0.042, 0.058)


_COMMON_MOTIONS: tuple[MotionPlan, ...] = (
    ("swing-fast", 0.0, 1.0),
    ("swing", 90.0, 1.8),
    ("stretch", 0.0, 1.5),
    ("turn", 0.0, 2.0),
    ("hang", 90.0, 2.0),
)
ROUND_SIZE = CaseSize(
    29, 13, (*_COMMON_MOTIONS, ("shake", 0.0, 1.5)), (*_COMMON_MOTIONS, ("drag-fast", 0.0, 1.0)), 0.0557
)
_FAST_SWING: MotionPlan = ("swing-fast", 0.0, 1.3)
FAST_SIZE = CaseSize(
    21, 9, (_FAST_SWING, ("turn", 0.0, 3.0)), (_FAST_SWING, ("drag-fast", 0.0, 1.3)), 0.0785, (0.075, 0.075)
)
UNSEEN_MOTION: MotionPlan = ("swing", 45.0, 1.4)  # no case has it


@dataclass(frozen=True)
class HiddenEffect:
    """An effect of the independent engine.

    Attributes:
        name: in the engine's catalogue.
        amplitude: SI.
        options: of the engine's effect, e.g. the heading.
        typical_fraction: amplitude over the typical one.
    """

    name: str
    amplitude: float
    options: dict[str, float] = field(default_factory=dict)
    typical_fraction: float = 1.0


@dataclass(frozen=True)
class EpisodePlan:
    """One episode.

    Attributes:
        motion: name.
        heading: degrees.
        speed: factor.
        effects: hidden in this episode only.
        start: m, x and y by which the sheet and the grippers are displaced from the usual place.
    """

    motion: str
    heading: float
    speed: float
    effects: tuple[HiddenEffect, ...] = ()
    start: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Case:
    """What is hidden in which episodes.

    Attributes:
        seed: determines everything else.
        family: one of ``FAMILY_CYCLE``.
        kind: says more within a family, e.g. the fraction of the typical amplitude, or "tilt or wind".
        size: of meshes and motions.
        effects: hidden in all episodes.
        episodes: in the order in which they are written.
        fabric: true values of the fabric.
        data_sheet_ratio: the data sheet's values over the true ones.
        bias: m, slowly varying depth error of the sensor.
        occlusion: -, fraction of the surface that is hidden from the sensor.
        nodes: vertices along the truth's sides.
        diagonals: of the truth's mesh.
        grip_radius: m.
        has_forces: gripper forces are recorded.
        fault: of the recording, or "".
        camera: position, target and roll of the sensor.
    """

    seed: int
    family: str
    kind: str
    size: CaseSize
    effects: tuple[HiddenEffect, ...]
    episodes: tuple[EpisodePlan, ...]
    fabric: dict[str, float]
    data_sheet_ratio: dict[str, float]
    bias: float = 0.35e-3
    occlusion: float = 0.0
    nodes: int = ROUND_SIZE.nodes
    diagonals: str = "alternating"
    grip_radius: float = 0.05
    has_forces: bool = True
    fault: str = ""
    camera: dict[str, Any] = field(default_factory=dict)

    @property
    def is_sealed(self) -> bool:
        """Whether nothing may be tuned on this case."""
        return self.seed >= FIRST_SEALED_SEED

    def plan_episode(self, motion: MotionPlan) -> EpisodePlan:
        """Return a further episode of this case with another motion."""
        return EpisodePlan(*motion, start=_draw_placement(self.seed, motion))


def draw_case(seed: int, size: CaseSize = ROUND_SIZE) -> Case:
    """Return the case of a seed.

    Raises:
        ValueError: a seed that is neither for development nor sealed.
    """
    if not (0 <= seed < DEVELOPMENT_SEEDS or seed >= FIRST_SEALED_SEED):
        raise ValueError(f"seed {seed}: expected 0 to {DEVELOPMENT_SEEDS - 1}, or {FIRST_SEALED_SEED} and more")
    rng = np.random.default_rng([seed, 7])
    cycle, position = divmod(seed, len(FAMILY_CYCLE))
    family = FAMILY_CYCLE[position]
    index = position - FAMILY_CYCLE.index(family)  # among the cycle's cases of this family
    draw_family = {
        "null": _draw_null,
        "hard null": _draw_hard_null,
        "single": _draw_single,
        "double": _draw_double,
        "confounded": _draw_confounded,
        "outside": _draw_outside,
        "fault": _draw_fault,
        "next experiment": _draw_next_experiment,
    }[family]
    fields = {"kind": "", "effects": (), "motions": _draw_motions(size, rng)} | draw_family(rng, cycle, index, size)
    regrasp, motions = fields.pop("regrasp", 0.0), _with_decoy_motions(fields.pop("motions"), seed, size)
    episodes = _balance_regrasps(tuple(_draw_episode(motion, regrasp, rng) for motion in motions), regrasp)
    placed = [replace(e, start=_draw_placement(seed, (e.motion, e.heading, e.speed))) for e in episodes]
    order = rng.permutation(len(placed))
    fields = {
        "nodes": size.nodes,
        "fabric": _draw_fabric(rng),
        "data_sheet_ratio": _draw_data_sheet_ratio(rng, 0.15),
    } | fields
    grip_radius = float(np.random.default_rng([seed, 17]).uniform(*size.grip_radii))
    ordered = tuple(placed[k] for k in order)
    return Case(seed, family, size=size, episodes=ordered, grip_radius=grip_radius, camera=_draw_camera(seed), **fields)


def draw_sealed_seeds(secret: int, count: int) -> list[int]:
    """Return ``count`` sealed seeds, of which every twenty hold the families in their proportions.

    The order says nothing about the family. A larger count begins with the same seeds.
    """
    rng = np.random.default_rng([secret, 11])
    seeds: list[int] = []
    while len(seeds) < count:
        cycle = int(rng.integers(10**9))
        seeds += [FIRST_SEALED_SEED + cycle * len(FAMILY_CYCLE) + int(k) for k in rng.permutation(len(FAMILY_CYCLE))]
    return seeds[:count]


def _draw_motions(size: CaseSize, rng: np.random.Generator) -> tuple[MotionPlan, ...]:
    return size.table if rng.random() < 0.5 else size.hanging


def _with_decoy_motions(motions: tuple[MotionPlan, ...], seed: int, size: CaseSize) -> tuple[MotionPlan, ...]:
    """Replace some of the usual motions on a table by motions that reveal friction or creases."""
    rng = np.random.default_rng([seed, 23])
    if size != ROUND_SIZE or motions != size.table or rng.random() > DECOY_MOTION_FRACTION:
        return motions
    decoys = (DRAG_MOTIONS, FOLD_MOTIONS)[int(rng.integers(2))]
    return (*motions[: len(motions) - len(decoys)], *decoys)


def _draw_placement(seed: int, motion: MotionPlan) -> tuple[float, float]:
    """Return where a sheet is put down: equal places in all episodes would reveal an offset of a millimetre."""
    rng = np.random.default_rng([seed, 21, zlib.crc32(repr(motion).encode())])
    x, y = rng.uniform(-PLACEMENT_RANGE_M, PLACEMENT_RANGE_M, 2)
    return float(x), float(y)


def _draw_camera(seed: int) -> dict[str, Any]:
    """Return the camera of a case: if all cameras stood at one place, a false pose could be read off."""
    rng = np.random.default_rng([seed, 19])
    eye, target = (
        tuple((np.array(p) + CAMERA_POSITION_STD_M * rng.standard_normal(3)).tolist()) for p in (EYE_M, TARGET_M)
    )
    return {"eye": eye, "target": target, "roll": float(CAMERA_ROLL_STD_RAD * rng.standard_normal())}


def _motions_that_show(size: CaseSize, rng: np.random.Generator, *names: str) -> tuple[MotionPlan, ...]:
    """Return motions in which the effects are visible."""
    mappings = [(SINGLE_EFFECTS | OUTSIDE_EFFECTS)[name] for name in names]
    special = tuple(dict.fromkeys(motion for m in mappings for motion in m.required_motions))
    motions = size.table if any(m.needs_table for m in mappings) else _draw_motions(size, rng)
    return (*motions[: len(motions) - len(special)], *special)


def _draw_episode(motion: MotionPlan, regrasp: float, rng: np.random.Generator) -> EpisodePlan:
    """Return an episode of a motion, which a person does not repeat exactly."""
    name, heading, speed = motion
    heading, speed = heading + rng.uniform(-HEADING_RANGE_DEG, HEADING_RANGE_DEG), speed * rng.uniform(*SPEED_RANGE)
    shift = rng.uniform(-regrasp, regrasp)
    # the whole sheet lies further along its own width than the robot reports
    effects = (HiddenEffect("robot.base", shift, {"heading": heading + 90.0}),) if regrasp else ()
    return EpisodePlan(name, float(heading), float(speed), effects)


def _balance_regrasps(episodes: tuple[EpisodePlan, ...], regrasp: float) -> tuple[EpisodePlan, ...]:
    """Make the shifts of episodes of one heading cancel: a common shift would be an offset of robot or camera."""
    quadrant = np.array([round(episode.heading / 90) for episode in episodes])
    shifts = np.array([episode.effects[0].amplitude if episode.effects else 0.0 for episode in episodes])
    for heading in set(quadrant.tolist()):
        shifts[quadrant == heading] -= shifts[quadrant == heading].mean()
    shifts *= min(1.0, regrasp / max(np.abs(shifts).max(), 1e-12))
    return tuple(
        replace(episode, effects=tuple(replace(effect, amplitude=float(shift)) for effect in episode.effects))
        for episode, shift in zip(episodes, shifts, strict=True)
    )


def _draw_fabric(rng: np.random.Generator) -> dict[str, float]:
    """Return a fabric near the engine's default: a lighter, stiffer sheet wrinkles at the size of any mesh."""
    return {
        "areal_density": 0.25 * float(np.exp(0.1 * rng.standard_normal())),
        "membrane_stiffness": 120.0 * float(np.exp(0.15 * rng.standard_normal())),
        "bending_stiffness": 6e-5 * float(np.exp(0.15 * rng.standard_normal())),
    }


def _draw_data_sheet_ratio(rng: np.random.Generator, log_std: float) -> dict[str, float]:
    """Return the data sheet's values over the true ones; the fabric was weighed to 2 %."""
    ratios = {name: float(np.exp(log_std * rng.standard_normal())) for name in FABRIC_STIFFNESSES}
    return {**ratios, "areal_density": float(np.clip(1 + 0.02 * rng.standard_normal(), 0.96, 1.04))}


def _draw_effect(
    name: str,
    typical_fraction: float,
    rng: np.random.Generator,
    mappings: dict[str, EffectMapping],
    headings: tuple[float, ...] = HEADINGS_DEG,
) -> tuple[HiddenEffect, ...]:
    """Return an effect at a fraction of its typical amplitude, after the effects that it needs to have a force."""
    mapping = mappings[name]
    typical = CATALOGUE[name].typical if mapping.typical is None else mapping.typical
    options = {"heading": float(rng.choice(headings))} if mapping.has_heading else {}
    amplitude = typical_fraction * typical * int(rng.choice(mapping.signs))
    enabling = (HiddenEffect(other, value) for other, value in mapping.enabling_effects)
    return (*enabling, HiddenEffect(name, amplitude, options, typical_fraction))


# Each of the following draws what is special in a case of its family: fields of ``Case``, "motions" and "regrasp".


def _draw_null(rng: np.random.Generator, cycle: int, index: int, size: CaseSize) -> Fields:
    exact = {"membrane_stiffness": 1.0, "bending_stiffness": 1.0, "areal_density": 1.0}
    return {"kind": "matched", "data_sheet_ratio": exact}


def _draw_hard_null(rng: np.random.Generator, cycle: int, index: int, size: CaseSize) -> Fields:
    """Draw everything that may be wrong without being a cause."""
    membrane, bending = np.exp(rng.uniform(np.log([0.4, 0.5]), np.log([2.5, 2.0])))
    stiffness_ratios = {"membrane_stiffness": float(membrane), "bending_stiffness": float(bending)}
    ratios = _draw_data_sheet_ratio(rng, 0.0) | stiffness_ratios
    name = str(rng.choice([n for n in SINGLE_EFFECTS if not SINGLE_EFFECTS[n].enabling_effects]))
    small = _draw_effect(name, float(rng.uniform(0.05, 0.2)), rng, SINGLE_EFFECTS)
    return {
        "kind": f"{name} too small to matter",
        "diagonals": str(rng.choice(["alternating", "parallel"])),
        "effects": small,
        "data_sheet_ratio": ratios,
        "motions": _motions_that_show(size, rng, name),
        "bias": 0.7e-3,
        "occlusion": 0.2,
        "regrasp": 4e-3,
    }


def _draw_single(rng: np.random.Generator, cycle: int, index: int, size: CaseSize) -> Fields:
    """Draw one effect: twelve cases of the family in a row run through the amplitudes, effects through the map."""
    fraction = (HALF_SIZE, TYPICAL_SIZE, LARGE_SIZE)[index % 3]
    name = list(SINGLE_EFFECTS)[(6 * cycle + index + cycle // len(SINGLE_EFFECTS)) % len(SINGLE_EFFECTS)]
    effects = _draw_effect(name, fraction, rng, SINGLE_EFFECTS)
    return {"kind": f"{fraction:g}", "effects": effects, "motions": _motions_that_show(size, rng, name)}


def _draw_double(rng: np.random.Generator, cycle: int, index: int, size: CaseSize) -> Fields:
    pair = PAIRED_EFFECTS[(2 * cycle + index) % len(PAIRED_EFFECTS)]
    effects = tuple(e for name in pair for e in _draw_effect(name, TYPICAL_SIZE, rng, SINGLE_EFFECTS))
    return {"kind": "two", "effects": effects, "motions": _motions_that_show(size, rng, *pair)}


def _draw_confounded(rng: np.random.Generator, cycle: int, index: int, size: CaseSize) -> Fields:
    kind = CONFOUNDED_KINDS[(2 * cycle + index) % len(CONFOUNDED_KINDS)]
    if kind == "tilt or wind":
        fields = _draw_tilt_or_wind(rng)
    elif kind == "base or extrinsic":
        name = str(rng.choice(["robot.base", "obs.extrinsic"]))
        fields = {"effects": _draw_effect(name, LARGE_SIZE, rng, SINGLE_EFFECTS), "motions": size.hanging}
    elif kind == "mass without forces":
        effects = _draw_effect("mass.density", LARGE_SIZE, rng, SINGLE_EFFECTS)
        fields = {"effects": effects, "motions": size.hanging, "has_forces": False}
    else:  # at one speed, linear and quadratic drag are confounded
        name = str(rng.choice(["air.linear", "air.drag_n"]))
        motions = (("swing", 0.0, 1.8), ("swing-fast", 0.0, 0.5), ("swing", 0.0, 1.8))
        count = 2 if size == FAST_SIZE else 3
        fields = {"effects": _draw_effect(name, HALF_SIZE, rng, SINGLE_EFFECTS), "motions": motions[:count]}
    return {"kind": kind, **fields}


def _draw_outside(rng: np.random.Generator, cycle: int, index: int, size: CaseSize) -> Fields:
    name = list(OUTSIDE_EFFECTS)[(2 * cycle + index) % len(OUTSIDE_EFFECTS)]
    fraction = TYPICAL_SIZE if rng.random() < 0.5 else LARGE_SIZE
    headings = (0.0, 180.0)  # a jet along y would miss the sheets, which hang half a metre out along x
    effects = _draw_effect(name, fraction, rng, OUTSIDE_EFFECTS, headings)
    return {"kind": f"{fraction:g}", "effects": effects, "motions": _motions_that_show(size, rng, name)}


def _draw_fault(rng: np.random.Generator, cycle: int, index: int, size: CaseSize) -> Fields:
    kind = FAULT_KINDS[cycle % len(FAULT_KINDS)]
    return {"kind": kind, "fault": kind}


def _draw_next_experiment(rng: np.random.Generator, cycle: int, index: int, size: CaseSize) -> Fields:
    """Draw a confounded case; the experiment that the answer proposes is then carried out."""
    return {"kind": "tilt or wind", **_draw_tilt_or_wind(rng)}


def _draw_tilt_or_wind(rng: np.random.Generator) -> Fields:
    """Draw wind or tilted gravity, which are confounded across a sheet that hangs still."""
    name = str(rng.choice(["env.gravity_tilt", "air.wind"]))
    motions = (("hang", 0.0, 1.0), ("drape", 0.0, 1.0), ("hang", 0.0, 1.4))
    return {"effects": _draw_effect(name, LARGE_SIZE, rng, SINGLE_EFFECTS, (0.0, 180.0)), "motions": motions}
