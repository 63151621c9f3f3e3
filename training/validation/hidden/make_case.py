"""Make the episodes of a hidden case. Nothing in them says what is hidden.

P=torchcloth.training.validation.hidden
python -m $P.make_case --seed 12 --out cases/12                                     # e1, e2, ... in that folder
python -m $P.make_case --seed 12 --motion lift --heading 90 --out cases/12-next     # one more episode
python -m $P.make_case --seed 12 --nodes 19 --out cases/12-coarse                   # the truth on another mesh
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

from ..independent.effects import add_effect
from ..independent.generate import make_recording
from ..independent.motions import make_motion
from ..independent.scene import Scene, simulate
from .case_sampling import FAST_SIZE, ROUND_SIZE, UNSEEN_MOTION, Case, EpisodePlan, HiddenEffect, draw_case
from .recording_faults import FAULTS

MIN_NODES = 9  # vertices along a side, so that grippers hold a few
# The last part of the points is cut off, longer than any clock is early: an early clock sees nothing of the end, and
# the number of frames must not reveal it.
CUT_OFF_S = 0.05
PROVENANCE = "synthetic: an engine of its own"


def make_scenes(case: Case, episode: EpisodePlan) -> tuple[Scene, Scene]:
    """Return the true scene of an episode, and the scene that the recording describes."""
    default, fabric, ratio = Scene(), case.fabric, case.data_sheet_ratio
    sheet = replace(
        default.sheet,
        nodes=(case.nodes, case.nodes),
        diagonals=case.diagonals,
        areal_density=fabric["areal_density"],
        membrane_stiffness=fabric["membrane_stiffness"],
    )
    plate = replace(default.plate, stiffness=fabric["bending_stiffness"])
    sensor = replace(default.sensor, bias=case.bias, occlusion=case.occlusion, **case.camera)
    grip = replace(default.grip, radius=case.size.vertex_radius)
    true = replace(default, sheet=sheet, plate=plate, sensor=sensor, grip=grip)
    described = replace(
        true,
        grip=replace(default.grip, radius=case.grip_radius),
        sheet=replace(
            sheet,
            areal_density=fabric["areal_density"] * ratio["areal_density"],
            membrane_stiffness=fabric["membrane_stiffness"] * ratio["membrane_stiffness"],
        ),
        plate=replace(plate, stiffness=fabric["bending_stiffness"] * ratio["bending_stiffness"]),
    )
    for effect in _merge_base_offsets(*case.effects, *episode.effects):
        true = add_effect(true, effect.name, effect.amplitude, effect.options)
    (u, _), grip = sheet.evenly_spaced.grid_lines, true.grip
    extra = case.grip_radius - u[u <= grip.radius].max()
    return replace(true, grip=replace(grip, extra_radius=grip.extra_radius + extra)), described


def _merge_base_offsets(*effects: HiddenEffect) -> list[HiddenEffect]:
    """Replace the offsets of the robot's base, the case's and the episode's, by their vector sum."""
    bases = [e for e in effects if e.name == "robot.base"]
    if len(bases) < 2:
        return list(effects)
    offset = sum(e.amplitude * np.exp(1j * np.deg2rad(e.options.get("heading", 0.0))) for e in bases)
    merged = HiddenEffect("robot.base", float(abs(offset)), {"heading": float(np.rad2deg(np.angle(offset)))})
    return [*(e for e in effects if e.name != "robot.base"), merged]


def make_episode(case: Case, episode: EpisodePlan, number: int) -> recordings.Recording:
    """Simulate and record one episode; its ``number`` makes its noise independent of the others'."""
    true, described = make_scenes(case, episode)
    motion = make_motion(episode.motion, true.sheet, episode.heading, episode.speed, episode.start)
    result = simulate(true, motion)
    seed, nodes = [case.seed, number], case.size.fit_nodes
    recording = make_recording(true, motion, result, episode.motion, seed, nodes, data_sheet_scene=described)
    points = recording.require("points")
    recording = replace(recording, points=points.select(points.t <= motion.t[-1] - CUT_OFF_S))
    if not case.has_forces:
        grippers = {name: replace(g, force=None, torque=None) for name, g in recording.grippers.items()}
        recording = replace(recording, grippers=grippers)
    fault_rng = np.random.default_rng([case.seed, 13])  # the same in all episodes
    return FAULTS[case.fault](replace(recording, truth=None, provenance=PROVENANCE), fault_rng)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--fast", action="store_true", help="fewer and shorter episodes, coarser meshes")
    parser.add_argument("--nodes", type=int, help="vertices along the truth's sides (default: as in all cases)")
    parser.add_argument("--motion", help="one more episode of the case, with this motion, instead of all")
    parser.add_argument("--heading", type=float, default=0.0, metavar="DEGREES")
    parser.add_argument("--speed", type=float, default=1.0, metavar="FACTOR")
    parser.add_argument("--unseen", action="store_true", help="one more episode, of a motion that no case has")
    options = parser.parse_args(arguments)
    try:
        case = draw_case(options.seed, FAST_SIZE if options.fast else ROUND_SIZE)
        if options.nodes is not None:
            if options.nodes < MIN_NODES:
                raise ValueError(
                    f"--nodes: got {options.nodes}; expected {MIN_NODES} or more, so that grippers hold a few"
                )
            case = replace(case, nodes=options.nodes)
        for number, episode in _choose_episodes(case, options):
            folder = options.out / f"e{number}"
            recordings.write(make_episode(case, episode, number), folder, overwrite=True)
            print(f"{folder}: {episode.motion}", flush=True)
    except (TorchclothError, ValueError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def _choose_episodes(case: Case, options: argparse.Namespace) -> list[tuple[int, EpisodePlan]]:
    count = len(case.episodes)
    if options.unseen:
        return [(count + 1, case.plan_episode(UNSEEN_MOTION))]
    if options.motion:
        key = zlib.crc32(f"{options.motion} {options.heading} {options.speed}".encode())
        return [(count + 2 + key % 1000, case.plan_episode((options.motion, options.heading, options.speed)))]
    return list(enumerate(case.episodes, 1))


if __name__ == "__main__":
    sys.exit(main())
