"""Write an episode from the files of a bench: joint angles in CSV, depth images in PNG, and a calibration.

arm = authoring.ArmFiles(urdf="robot.urdf", tool="tcp", joints="joints.csv", grip=(0.2, 0.3), is_bar=True)
camera = authoring.CameraFiles(depth="depth", intrinsics="K.json", pose="T.txt")
episode = authoring.new_episode([arm], camera, sheet=(0.4, 0.3))
episode.write("my_episode")
"""

from .bench_files import ArmFiles, CameraFiles
from .new_episode import PICTURE_FILE, NewEpisode, new_episode

__all__ = ["PICTURE_FILE", "ArmFiles", "CameraFiles", "NewEpisode", "new_episode"]
