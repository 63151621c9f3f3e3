"""Episodes that nobody has done yet: scene, first shape and motion, for a robot to carry out and record."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ..errors import TorchclothError
from .reading import read
from .types import Recording

FILES = frozenset(("episode.json", "motion.npz", "cloth.obj", "cloth_initial.npy"))  # while nothing is recorded


def undone(recording: Recording, provenance: str) -> Recording:
    """Without all that was seen and felt."""
    return replace(
        recording,
        grippers={name: replace(g, force=None, torque=None) for name, g in recording.grippers.items()},
        joints={name: replace(j, force=None, torque=None) for name, j in recording.joints.items()},
        cameras={name: replace(c, depth=None, color=None, mask=None) for name, c in recording.cameras.items()},
        points=None,
        markers=None,
        truth=None,
        provenance=provenance,
    )


def is_undone(folder: Path, provenance: str) -> bool:
    """Written with this provenance, and nothing recorded into it since."""
    if folder.is_symlink() or not folder.is_dir() or not {path.name for path in folder.iterdir()} <= FILES:
        return False
    try:
        found = read(folder)
    except TorchclothError:
        return False
    felt = [g.force is not None or g.torque is not None for g in (*found.grippers.values(), *found.joints.values())]
    return found.provenance == provenance and not any(felt)
