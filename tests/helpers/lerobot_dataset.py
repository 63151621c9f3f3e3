"""Makes the data set in tests/recordings/formats/lerobot by lerobot's own writer (``pip install lerobot==0.4.4``).

Two episodes of 6 and 8 frames, one camera, seven joint angles and a gripper opening as LeRobot stores them. The
numbers come from the functions below, which the tests call for the truth. Ours; CC0, free of any rights.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

FOLDER = Path(__file__).parents[1] / "recordings" / "formats" / "lerobot"
FPS = 10
LENGTHS = (6, 8)
WIDTH, HEIGHT = 96, 64
CAMERA = "observation.images.top"
NAMES = [*(f"joint_{i}.pos" for i in range(1, 8)), "gripper.width"]


def state(episode: int, frame: int) -> np.ndarray:
    """Joint angles [rad] and opening [m] of one frame, [8] float32."""
    q = 0.3 * np.sin(0.2 * frame + np.arange(7) + episode)
    return np.append(q, 0.04 - 0.005 * frame).astype(np.float32)


def grey(episode: int, frame: int) -> int:
    """The grey level of one picture, which survives a lossy codec."""
    return 40 + 90 * episode + 10 * frame


def main() -> None:
    """Write the two episodes."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset  # pyright: ignore[reportMissingImports]

    root = FOLDER / "dataset"
    shutil.rmtree(root, ignore_errors=True)
    vector = {"dtype": "float32", "shape": (8,), "names": NAMES}
    image = {"dtype": "video", "shape": (HEIGHT, WIDTH, 3), "names": ["height", "width", "channels"]}
    dataset = LeRobotDataset.create(
        repo_id="torchcloth/tiny",
        fps=FPS,
        root=root,
        robot_type="two_finger_arm",
        features={"observation.state": vector, "action": vector, CAMERA: image},
        use_videos=True,
    )
    for episode, length in enumerate(LENGTHS):
        for frame in range(length):
            dataset.add_frame(
                {
                    "observation.state": state(episode, frame),
                    "action": state(episode, frame + 1),
                    CAMERA: np.full((HEIGHT, WIDTH, 3), grey(episode, frame), dtype=np.uint8),
                    "task": "lift the cloth",
                }
            )
        dataset.save_episode()
    dataset.finalize()
    shutil.rmtree(root / "images", ignore_errors=True)
    (root / "meta" / "stats.json").unlink()  # 11 kB over all episodes, which no reader of one episode needs


if __name__ == "__main__":
    main()
