"""What camera and clock may do other than they say."""

from __future__ import annotations

from functools import partial

import torch

from ..identification.episodes import Episode
from ..identification.nuisances import Camera, Clock, Rim
from ..identification.replays import Frames
from .world import Hypothesis, World

AXES = "xyz"


def _see(kind: Clock | Camera | Rim, index: int, count: int, world: World, amplitude: float) -> World:
    values = torch.zeros(count, dtype=torch.get_default_dtype())
    values[index] = amplitude

    def view(frames: Frames, episode: Episode) -> Frames:
        return kind.see(frames, values.to(frames.x), episode)

    return world.with_view(view)


_CAMERA, _CLOCK, _RIM = Camera(), Clock(), Rim()
HYPOTHESES = (
    *(
        Hypothesis(f"obs.extrinsic[{axis}]", "m", 4e-3, partial(_see, _CAMERA, k, 6), signed=True, kin=("robot.base",))
        for k, axis in enumerate(AXES)
    ),
    *(
        Hypothesis(f"obs.rotation[{axis}]", "rad", 0.02, partial(_see, _CAMERA, 3 + k, 6), signed=True)
        for k, axis in enumerate(AXES)
    ),
    Hypothesis("obs.clock", "s", 0.03, partial(_see, _CLOCK, 0, 1), signed=True),
    Hypothesis("obs.edge", "m", 8e-3, partial(_see, _RIM, 0, 1), signed=True),
)
