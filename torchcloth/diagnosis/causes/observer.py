"""Causes in the camera and the clock."""

from __future__ import annotations

from functools import partial

import torch

from ...episodes.observed import Episode, find_depth_camera
from ...episodes.replay import Frames
from ...episodes.world import Hypothesis, World
from ...identification.nuisances import CameraOffset, ClockOffset, RimOffset
from ...recordings import Recording

AXES = "xyz"


def _shift_observer(
    kind: ClockOffset | CameraOffset | RimOffset, index: int, count: int, world: World, amplitude: float
) -> World:
    values = torch.zeros(count, dtype=torch.get_default_dtype())
    values[index] = amplitude

    def view(frames: Frames, episode: Episode) -> Frames:
        return kind.observe(frames, values.to(frames.x), episode)

    return world.with_observation_transform(view)


def _change_depth(world: World, fraction: float = 0.0, offset: float = 0.0) -> World:
    """Change depths along the rays of an episode's only camera; episodes without one stay as they are."""

    def view(frames: Frames, episode: Episode) -> Frames:
        if episode.camera_position is None:
            return frames
        ray = frames.x - episode.camera_position
        return frames._replace(x=frames.x + ray * (fraction + offset / ray.norm(dim=-1, keepdim=True)))

    return world.with_observation_transform(view)


def _has_depth_camera(recording: Recording) -> bool:
    return find_depth_camera(recording) is not None


_CAMERA, _CLOCK, _RIM = CameraOffset(), ClockOffset(), RimOffset()
HYPOTHESES = (
    *(
        Hypothesis(
            f"obs.extrinsic[{axis}]",
            "m",
            4e-3,
            partial(_shift_observer, _CAMERA, k, 6),
            signed=True,
            structurally_equivalent=("robot.base",),
            title="Camera offset",
            description="The cloud lies so much too far along x, y or z of the world: "
            "T_world_camera is off by as much.",
        )
        for k, axis in enumerate(AXES)
    ),
    *(
        Hypothesis(
            f"obs.rotation[{axis}]",
            "rad",
            0.02,
            partial(_shift_observer, _CAMERA, 3 + k, 6),
            signed=True,
            title="Camera rotation",
            description="The cloud is turned about x, y or z of the world, around the cloth, by the right hand.",
        )
        for k, axis in enumerate(AXES)
    ),
    Hypothesis(
        "obs.clock",
        "s",
        0.03,
        partial(_shift_observer, _CLOCK, 0, 1),
        signed=True,
        title="Clock offset",
        description="Frames were taken later than their stamps say, or earlier where negative.",
    ),
    Hypothesis(
        "obs.edge",
        "m",
        8e-3,
        partial(_shift_observer, _RIM, 0, 1),
        signed=True,
        title="Offset of the rim",
        description="The cloud's rim lies farther out than the cloth's: flying pixels, or erosion where negative.",
    ),
    Hypothesis(
        "obs.depth_scale",
        "-",
        0.015,
        lambda w, a: _change_depth(w, fraction=a),
        signed=True,
        is_applicable=_has_depth_camera,
        title="Scale of depth",
        description="The camera's depths are too large by a share.",
    ),
    Hypothesis(
        "obs.depth_bias",
        "m",
        5e-3,
        lambda w, a: _change_depth(w, offset=a),
        signed=True,
        is_applicable=_has_depth_camera,
        title="Offset of depth",
        description="The camera's depths are too large by a constant.",
    ),
)
