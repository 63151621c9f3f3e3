"""Makes the data set in tests/recordings/formats/lerobot by lerobot's own writer (``pip install lerobot==0.4.4``).

Two episodes of 6 and 8 frames, one camera, seven joint angles and a gripper opening as LeRobot stores them. The
functions below give the values, and tests call them for the truth. Ours; CC0, free of any rights.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

LEROBOT_FOLDER = Path(__file__).parents[1] / "recordings" / "formats" / "lerobot"
DATASET_RATE_HZ = 10
EPISODE_LENGTHS = (6, 8)
VIDEO_WIDTH_PX, VIDEO_HEIGHT_PX = 96, 64
CAMERA_KEY = "observation.images.top"
STATE_NAMES = [*(f"joint_{i}.pos" for i in range(1, 8)), "gripper.width"]


def make_state(episode: int, frame: int) -> np.ndarray:
    """Return joint angles [rad] and opening [m] of one frame, [8] float32."""
    q = 0.3 * np.sin(0.2 * frame + np.arange(7) + episode)
    return np.append(q, 0.04 - 0.005 * frame).astype(np.float32)


def grey_level(episode: int, frame: int) -> int:
    """Return the grey level of one picture, which survives a lossy codec."""
    return 40 + 90 * episode + 10 * frame


def main() -> None:
    """Write the two episodes."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset  # pyright: ignore[reportMissingImports]

    root = LEROBOT_FOLDER / "dataset"
    shutil.rmtree(root, ignore_errors=True)
    vector = {"dtype": "float32", "shape": (8,), "names": STATE_NAMES}
    image = {"dtype": "video", "shape": (VIDEO_HEIGHT_PX, VIDEO_WIDTH_PX, 3), "names": ["height", "width", "channels"]}
    dataset = LeRobotDataset.create(
        repo_id="torchcloth/tiny",
        fps=DATASET_RATE_HZ,
        root=root,
        robot_type="two_finger_arm",
        features={"observation.state": vector, "action": vector, CAMERA_KEY: image},
        use_videos=True,
    )
    for episode, length in enumerate(EPISODE_LENGTHS):
        for frame in range(length):
            dataset.add_frame(
                {
                    "observation.state": make_state(episode, frame),
                    "action": make_state(episode, frame + 1),
                    CAMERA_KEY: np.full(
                        (VIDEO_HEIGHT_PX, VIDEO_WIDTH_PX, 3), grey_level(episode, frame), dtype=np.uint8
                    ),
                    "task": "lift the cloth",
                }
            )
        dataset.save_episode()
    dataset.finalize()
    shutil.rmtree(root / "images", ignore_errors=True)
    (root / "meta" / "stats.json").unlink()  # 11 kB over all episodes, which no reader of one episode needs


if __name__ == "__main__":
    main()
