"""Episode templates: scene, first shape and motion, for a robot to execute and record."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ..errors import TorchclothError
from .reading import read
from .robot_files import ROBOTS_FOLDER
from .types import Recording

TEMPLATE_FILES = frozenset(
    ("episode.json", "motion.npz", "cloth.obj", "cloth_initial.npy", "cloth_velocities.npy", ROBOTS_FOLDER)
)


def as_template(recording: Recording, provenance: str) -> Recording:
    """Return the episode without any observation or force."""
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


def is_template(folder: Path, provenance: str) -> bool:
    """Return whether a folder was written with this provenance and nothing has been recorded into it since."""
    if folder.is_symlink() or not folder.is_dir() or not {path.name for path in folder.iterdir()} <= TEMPLATE_FILES:
        return False
    try:
        recording = read(folder)
    except TorchclothError:
        return False
    has_forces = [
        g.force is not None or g.torque is not None for g in (*recording.grippers.values(), *recording.joints.values())
    ]
    return recording.provenance == provenance and not any(has_forces)
