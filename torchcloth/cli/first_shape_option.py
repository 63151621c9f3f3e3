"""The option of verbs that take the first shape of an episode from a network instead of from its folder."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..cloth import Cloth
    from ..pose import PoseEstimator
    from ..recordings import Recording

SHIPPED = "shipped"


def add_network_option(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--network`` to a verb's parser."""
    parser.add_argument(
        "--network",
        nargs="?",
        const=SHIPPED,
        metavar="FILE",
        help="take the first shape from the first clouds by a network: the shipped one, or the weights in FILE of "
        "python -m torchcloth.training.pose; stands after EPISODE (default: the first shape that the episode has)",
    )


def read_network(options: argparse.Namespace) -> PoseEstimator | None:
    """Return the network of the option; None without it."""
    from ..pose import load_network

    if options.network is None:
        return None
    return load_network(None if options.network == SHIPPED else Path(options.network))


def estimate_first_shapes(
    options: argparse.Namespace, cloth: Cloth, episodes: Sequence[Recording]
) -> tuple[list[Recording], float | None]:
    """Return the episodes with first shapes by the network, and their error [m]; as they are, None, without it."""
    from ..pose import estimate_first_shape

    network = read_network(options)
    if network is None:
        return list(episodes), None
    shapes = [estimate_first_shape(cloth, episode, network) for episode in episodes]
    for episode, shape in zip(episodes, shapes, strict=True):
        name = episode.path.name if episode.path else "episode"
        print(f"{name}: first shape by the network, standard error {1e3 * shape.std_rms:.1f} mm")
        for warning in shape.warnings:
            print(f"warning: {name}: {warning}")
    recordings = [shape.apply(episode) for shape, episode in zip(shapes, episodes, strict=True)]
    return recordings, max(shape.std_rms for shape in shapes)
