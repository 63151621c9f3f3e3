"""Who takes part, by name; each is built in a process of its own."""

from __future__ import annotations

from importlib import import_module, metadata
from importlib.util import find_spec
from typing import NamedTuple

from torchcloth.errors import InvalidInput

from .cases import engines
from .contestant import Contestant


class Peer(NamedTuple):
    """Another simulator."""

    title: str
    module: str  # of ours, with
    factory: str  # that takes the number of threads
    package: str  # that must be importable
    distribution: str  # as pip calls it


PEERS = {
    "taichi": Peer("our MPM in Taichi", "taichi_mpm", "Taichi", "taichi", "taichi"),
    "warp": Peer("our MPM in Warp", "warp_mpm", "Warp", "warp", "warp-lang"),
    "newton": Peer("Newton SemiImplicit cloth", "newton_cloth", "Newton", "newton", "newton"),
    "mujoco": Peer("MuJoCo flex", "mujoco_flex", "MuJoCo", "mujoco", "mujoco"),
}


def build(name: str, threads: int) -> Contestant:
    """Import and start a contestant in this process.

    Raises:
        InvalidInput: neither an engine nor a peer.
    """
    if name in PEERS:
        peer = PEERS[name]
        return getattr(import_module(f".peers.{peer.module}", __package__), peer.factory)(threads)
    if name not in engines():
        raise InvalidInput("contestant", got=repr(name), expected=f"one of {', '.join([*engines(), *PEERS])}")
    from .ours import Ours

    return Ours(name, threads)


def absent() -> dict[str, str]:
    """Peers that are not installed, and how to install them."""
    return {
        name: f"pip install {peer.distribution}, or all: pip install 'torchcloth[bench]'"
        for name, peer in PEERS.items()
        if find_spec(peer.package) is None or not _is_known(peer.distribution)
    }


def _is_known(distribution: str) -> bool:
    """A folder of a package's name is none."""
    try:
        return bool(metadata.version(distribution))
    except metadata.PackageNotFoundError:
        return False


def versions() -> dict[str, str]:
    """Of torch and the peers that are there."""
    here = [peer.distribution for name, peer in PEERS.items() if name not in absent()]
    return {name: metadata.version(name) for name in ("torchcloth", "torch", *here)}


def best_engine() -> str:
    """What a user gets by default."""
    return engines()[0]
