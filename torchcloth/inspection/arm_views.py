"""Find arms that a depth camera sees and that nothing tells apart from the cloth."""

from __future__ import annotations

import numpy as np
import torch

from ..errors import TorchclothError
from ..recordings import Camera, Recording
from ..robots.replay import arm_from_recording  # pyright: ignore[reportMissingImports] - mapped from robots/

CHECKED_POSTURES = 20


def describe_unmodelled_arms(recording: Recording) -> list[str]:
    """Return a note for each arm without solids, or with meshes that cannot be read, in view of a depth camera."""
    cameras = {name: camera for name, camera in recording.cameras.items() if camera.depth is not None}
    notes = []
    for name, joints in recording.joints.items() if cameras else ():
        try:
            arm = arm_from_recording(recording, name)
            chosen = np.unique(np.linspace(0, len(joints.t) - 1, CHECKED_POSTURES).astype(int))
            q = torch.as_tensor(joints.q[chosen], dtype=torch.float64)
            places = arm.body_poses(q)[..., :3, 3].reshape(-1, 3).numpy()
        except TorchclothError:  # an unknown arm, of which other notes tell
            continue
        unread = arm.unread_meshes
        if not unread and arm.geometry(q):
            continue
        seeing = [camera for camera, lens in cameras.items() if _is_in_view(places, lens)]
        if seeing:
            links = f"{', '.join(list(unread)[:3])}{' and others' if len(unread) > 3 else ''}"
            what = f"solids of {links}" if unread else "solids"
            reason = f" ({next(iter(unread.values()))})" if unread else ""
            notes.append(
                f"{', '.join(seeing)} sees the arm {name!r}, whose URDF has no {what}: segmentation takes the arm for "
                f"cloth where they touch; add meshes, boxes, cylinders or spheres to its URDF{reason}"
            )
    return notes


def _is_in_view(places: np.ndarray, camera: Camera) -> bool:
    """Whether one of the places [N, 3] m is in the camera's image, as seen without distortion."""
    world_camera = camera.T_world_camera
    local = (places - world_camera[:3, 3]) @ world_camera[:3, :3]
    local = local[local[:, 2] > 0]
    pixels = local @ camera.K.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    return bool(((pixels >= 0) & (pixels < [camera.width, camera.height])).all(axis=1).any())
