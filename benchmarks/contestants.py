"""The contestants by name; each is built in a process of its own."""

from __future__ import annotations

from importlib import import_module, metadata
from importlib.util import find_spec
from typing import NamedTuple

from torchcloth.errors import InvalidInput

from .cases import engines
from .contestant import Contestant


class Peer(NamedTuple):
    """Another simulator.

    Attributes:
        title: name for tables.
        module: module of ``peers`` that wraps it.
        factory: class of that module, which takes the number of threads.
        package: package that must be importable.
        distribution: its name for pip.
    """

    title: str
    module: str
    factory: str
    package: str
    distribution: str


PEERS = {
    "taichi": Peer("our MPM in Taichi", "taichi_mpm", "Taichi", "taichi", "taichi"),
    "warp": Peer("our MPM in Warp", "warp_mpm", "Warp", "warp", "warp-lang"),
    "newton": Peer("Newton SemiImplicit cloth", "newton_cloth", "Newton", "newton", "newton"),
    "mujoco": Peer("MuJoCo flex", "mujoco_flex", "MuJoCo", "mujoco", "mujoco"),
}


def build_contestant(name: str, threads: int) -> Contestant:
    """Return a contestant that runs in this process.

    Raises:
        InvalidInput: the name is neither that of an engine nor that of a peer.
    """
    if name in PEERS:
        peer = PEERS[name]
        return getattr(import_module(f".peers.{peer.module}", __package__), peer.factory)(threads)
    if name not in engines():
        raise InvalidInput("contestant", got=repr(name), expected=f"one of {', '.join([*engines(), *PEERS])}")
    from .ours import TorchclothContestant

    return TorchclothContestant(name, threads)


def missing_peers() -> dict[str, str]:
    """Return the peers that are not installed, each with the command that installs it."""
    return {
        name: f"pip install {peer.distribution}, or all: pip install 'torchcloth[bench]'"
        for name, peer in PEERS.items()
        if find_spec(peer.package) is None or not _is_known(peer.distribution)
    }


def _is_known(distribution: str) -> bool:
    """A folder of the package's name is not the package."""
    try:
        return bool(metadata.version(distribution))
    except metadata.PackageNotFoundError:
        return False


def versions() -> dict[str, str]:
    """Return the versions of torchcloth, torch and the installed peers."""
    installed = [peer.distribution for name, peer in PEERS.items() if name not in missing_peers()]
    return {name: metadata.version(name) for name in ("torchcloth", "torch", *installed)}
