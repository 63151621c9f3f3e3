"""An episode in which a depth camera sees an arm, and is not where it says."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from helpers.foreign_formats import encode_png
from helpers.swinging_cloth import make_episode
from torchcloth import recordings as rec

GUESS_SHIFT_M = (0.05, 0.02, -0.03)
DEPTH_UNIT_M = 1e-4


def write_arm_view(folder: Path) -> tuple[Path, np.ndarray]:
    """Write an episode of an arm in motion; return its folder and the camera's true pose [4, 4]."""
    from torchcloth.training.studies.camera import make_view

    view = make_view("kinect", 5, has_faults=False, shrink=4)
    images = folder.parent / f"{folder.name}_images"
    images.mkdir()
    paths = tuple(images / f"{k}.png" for k in range(len(view.depths)))
    for path, depth in zip(paths, view.depths, strict=True):
        path.write_bytes(encode_png(np.rint(depth / DEPTH_UNIT_M).astype(np.uint16)))
    camera, (t, q) = view.camera, view.motion
    depth = rec.ImageStream("depth", np.arange(len(paths)), view.times, paths, (camera.width, camera.height))
    guess = camera.T_world_camera.copy()
    guess[:3, 3] += GUESS_SHIFT_M
    calibration = {**camera.to_calibration(), "T_world_camera": guess, "depth_scale": DEPTH_UNIT_M}
    recording = replace(
        make_episode(),
        joints={"arm": rec.JointMotion(t, q, closed=np.ones(len(t), bool))},
        robots={"arm": rec.RobotInfo("rizon4", np.eye(4), "tcp_closed")},
        cameras={"cam0": rec.Camera(**calibration, depth=depth)},
        grippers={},
        points=None,
    )
    return rec.write(recording, folder), camera.T_world_camera
