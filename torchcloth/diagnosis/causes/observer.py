"""What camera and clock may do other than they say."""

from __future__ import annotations

from functools import partial

import torch

from ...episodes.observed import Episode, find_depth_camera
from ...episodes.replay import Frames
from ...episodes.world import Hypothesis, World
from ...identification.nuisances import Camera, Clock, Rim
from ...recordings import Recording

AXES = "xyz"


def _see(kind: Clock | Camera | Rim, index: int, count: int, world: World, amplitude: float) -> World:
    values = torch.zeros(count, dtype=torch.get_default_dtype())
    values[index] = amplitude

    def view(frames: Frames, episode: Episode) -> Frames:
        return kind.see(frames, values.to(frames.x), episode)

    return world.with_view(view)


def _depth(world: World, share: float = 0.0, offset: float = 0.0) -> World:
    """Along the rays of the one camera that an episode has; others stay as they are."""

    def view(frames: Frames, episode: Episode) -> Frames:
        if episode.camera_position is None:
            return frames
        ray = frames.x - episode.camera_position
        return frames._replace(x=frames.x + ray * (share + offset / ray.norm(dim=-1, keepdim=True)))

    return world.with_view(view)


def _one_camera(recording: Recording) -> bool:
    return find_depth_camera(recording) is not None


_CAMERA, _CLOCK, _RIM = Camera(), Clock(), Rim()
HYPOTHESES = (
    *(
        Hypothesis(f"obs.extrinsic[{axis}]", "m", 4e-3, partial(_see, _CAMERA, k, 6), signed=True, structurally_equivalent=("robot.base",))
        for k, axis in enumerate(AXES)
    ),
    *(
        Hypothesis(f"obs.rotation[{axis}]", "rad", 0.02, partial(_see, _CAMERA, 3 + k, 6), signed=True)
        for k, axis in enumerate(AXES)
    ),
    Hypothesis("obs.clock", "s", 0.03, partial(_see, _CLOCK, 0, 1), signed=True),
    Hypothesis("obs.edge", "m", 8e-3, partial(_see, _RIM, 0, 1), signed=True),
    Hypothesis("obs.depth_scale", "-", 0.015, lambda w, a: _depth(w, share=a), signed=True, needs=_one_camera),
    Hypothesis("obs.depth_bias", "m", 5e-3, lambda w, a: _depth(w, offset=a), signed=True, needs=_one_camera),
)
