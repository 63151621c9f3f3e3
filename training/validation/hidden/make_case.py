"""Makes the episodes of a hidden case, and tells nothing.

python -m torchcloth.training.validation.hidden.make_case --seed 12 --out cases/12            # e1, e2, ... in that folder
python -m torchcloth.training.validation.hidden.make_case --seed 12 --motion lift --heading 90 --out cases/12-next   # one more
python -m torchcloth.training.validation.hidden.make_case --seed 12 --nodes 19 --out cases/12-coarse                 # the truth on another mesh
"""

from __future__ import annotations

import argparse
import sys
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np

from torchcloth import recordings
from torchcloth.errors import TorchclothError

from ..independent.effects import hide
from ..independent.generate import record
from ..independent.motions import motion
from ..independent.scene import Scene, simulate
from .case_sampling import REDUCED, SMALL, UNSEEN, Case, Hidden, Take, case
from .recording_faults import FAULTS

FEWEST = 9  # vertices along a side
LAST = 0.05  # s, longer than any clock is early
SAID_BY = "synthetic: an engine of its own"


def scenes(found: Case, take: Take) -> tuple[Scene, Scene]:
    """(what is, what is said) in an episode."""
    plain, fabric = Scene(), found.fabric
    sheet = replace(
        plain.sheet,
        nodes=(found.nodes, found.nodes),
        diagonals=found.diagonals,
        areal_density=fabric["areal_density"],
        membrane_stiffness=fabric["membrane_stiffness"],
    )
    plate = replace(plain.plate, stiffness=fabric["bending_stiffness"])
    sensor = replace(plain.sensor, bias=found.bias, occlusion=found.occlusion, **found.camera)
    true = replace(plain, sheet=sheet, plate=plate, sensor=sensor, grip=replace(plain.grip, radius=found.size.pad))
    said = replace(
        true,
        grip=replace(plain.grip, radius=found.pad),
        sheet=replace(
            sheet,
            areal_density=fabric["areal_density"] * found.said["areal_density"],
            membrane_stiffness=fabric["membrane_stiffness"] * found.said["membrane_stiffness"],
        ),
        plate=replace(plate, stiffness=fabric["bending_stiffness"] * found.said["bending_stiffness"]),
    )
    for effect in _as_one(*found.effects, *take.own):
        true = _hidden(true, effect)
    (u, _), grip = sheet.even.lines, true.grip
    beyond = found.pad - u[u <= grip.radius].max()
    return replace(true, grip=replace(grip, wider=grip.wider + beyond)), said


def _as_one(*effects: Hidden) -> list[Hidden]:
    """Robots that are off in two ways, for the case and for the episode, are off by the sum: along one heading."""
    bases = [e for e in effects if e.name == "robot.base"]
    if len(bases) < 2:
        return list(effects)
    along = sum(e.amplitude * np.exp(1j * np.deg2rad(e.options.get("heading", 0.0))) for e in bases)
    whole = Hidden("robot.base", float(abs(along)), {"heading": float(np.rad2deg(np.angle(along)))})
    return [*(e for e in effects if e.name != "robot.base"), whole]


def _hidden(scene: Scene, effect: Hidden) -> Scene:
    return hide(scene, effect.name, effect.amplitude, effect.options)


def episode(found: Case, take: Take, number: int) -> recordings.Recording:
    """One episode; ``number`` keeps its noise apart from the others'."""
    true, said = scenes(found, take)
    moved = motion(take.motion, true.sheet, take.heading, take.speed, take.start)
    result = simulate(true, moved)
    made = record(true, moved, result, take.motion, [found.seed, number], found.size.fit, said=said)
    if made.points is not None:  # an early clock sees nothing of the end: nobody may count its frames
        made = replace(made, points=made.points.only(made.points.t <= moved.t[-1] - LAST))
    if not found.forces:
        made = replace(made, grippers={k: replace(g, force=None, torque=None) for k, g in made.grippers.items()})
    wrong = np.random.default_rng([found.seed, 13])  # the same in all episodes
    return FAULTS[found.fault](replace(made, truth=None, provenance=SAID_BY), wrong)


def main(arguments: list[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--fast", action="store_true", help="fewer and shorter episodes, coarser meshes")
    parser.add_argument("--nodes", type=int, help="vertices along the truth's sides, of which all cases have the same")
    parser.add_argument("--motion", help="one more episode of the case, with this motion, instead of all")
    parser.add_argument("--heading", type=float, default=0.0, metavar="DEGREES")
    parser.add_argument("--speed", type=float, default=1.0, metavar="FACTOR")
    parser.add_argument("--unseen", action="store_true", help="one more episode, of a motion that no case has")
    options = parser.parse_args(arguments)
    try:
        found = case(options.seed, SMALL if options.fast else REDUCED)
        if options.nodes is not None:
            found = replace(found, nodes=_enough(options.nodes))
        for number, take in _asked(found, options):
            made = episode(found, take, number)
            recordings.write(made, options.out / f"e{number}", overwrite=True)
            print(f"{options.out / f'e{number}'}: {take.motion}", flush=True)
    except (TorchclothError, ValueError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def _enough(nodes: int) -> int:
    if nodes < FEWEST:
        raise ValueError(f"--nodes: got {nodes}; expected {FEWEST} or more, so that grippers hold a few")
    return nodes


def _asked(found: Case, options: argparse.Namespace) -> list[tuple[int, Take]]:
    count = len(found.takes)
    if options.unseen:
        return [(count + 1, found.take(UNSEEN))]
    if options.motion:
        key = zlib.crc32(f"{options.motion} {options.heading} {options.speed}".encode())
        return [(count + 2 + key % 1000, found.take((options.motion, options.heading, options.speed)))]
    return list(enumerate(found.takes, 1))


if __name__ == "__main__":
    sys.exit(main())
