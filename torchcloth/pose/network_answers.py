"""A network's answers to all clouds of a recording, as data of the smoother beside the clouds themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from ..cloth import Cloth
from ..episodes.observed import build_episode
from ..recordings import Markers, Recording
from .first_shape import pose_inputs, without_first_shape
from .network import PoseEstimator
from .scene_frame import rest_coordinates

MIN_POINTS_FOR_NETWORK = 20  # of a frame that the network looks at
VERTICES_PER_MARKER = 6  # errors of neighbours are alike
CLOUDS_IN_COMMON = 10  # successive clouds, and neighbours, that share an error count as one answer


def add_network_answers(cloth: Cloth, recording: Recording, network: PoseEstimator) -> tuple[Recording, float]:
    """Return the recording with the network's answers as markers, and their standard deviation [m].

    The network sees each cloud by itself and knows shapes, the simulation knows what follows from what. The standard
    deviation is that of the network, for as many independent answers as there are.

    Args:
        cloth: of the recording.
        recording: one episode, without markers.
        network: that is asked.

    Raises:
        InvalidInput: a cloth whose vertices have no single pattern coordinates.
    """
    episode = build_episode(cloth, without_first_shape(recording), has_first_shape=False)
    rest, uv = rest_coordinates(cloth.mesh), cloth.mesh.uv
    assert uv is not None
    chosen = np.arange(0, len(rest), VERTICES_PER_MARKER)
    places, variances = np.full((len(episode.times), len(chosen), 3), np.nan), []
    with torch.no_grad():
        for frame, cloud in enumerate(episode.clouds):
            if len(cloud) >= MIN_POINTS_FOR_NETWORK:
                answer = network(pose_inputs(cloth, episode, frame, rest, seed=frame))
                places[frame] = answer.x[0, chosen].double().numpy()
                variances.append(float(answer.std.square().mean()))
    markers = Markers(episode.times.numpy() - recording.clock_offset, places, np.asarray(uv)[chosen])
    return replace(recording, markers=markers), float(np.sqrt(CLOUDS_IN_COMMON * np.mean(variances)))
