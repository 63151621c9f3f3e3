"""Makes the files in tests/recordings/formats/mcap by the MCAP project's own writer.

The writer comes with ``pip install mcap mcap-ros2-support``. The files hold five poses of a gripper, in chunks and
with checksums as ROS 2 recorders leave them. Ours; CC0, free of any rights.
"""

from __future__ import annotations

import io
from pathlib import Path

MCAP_FOLDER = Path(__file__).parents[1] / "recordings" / "formats" / "mcap"
FIRST_POSE_NS = 1_700_000_000_000_000_000

POSE_MESSAGE_DEFINITION = """std_msgs/Header header
geometry_msgs/Pose pose
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
================================================================================
MSG: geometry_msgs/Pose
geometry_msgs/Point position
geometry_msgs/Quaternion orientation
================================================================================
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
"""


def gripper_position(i: int) -> list[float]:
    """Return the position [m] of the gripper at pose ``i``."""
    return [0.1 * i, -0.2, 0.3 + 0.01 * i]


def write_file(path: Path, *, data_crcs: bool) -> None:
    """Write one file, with checksums of its chunks and, if ``data_crcs``, of the data section."""
    from mcap.writer import CompressionType
    from mcap.writer import Writer as McapWriter
    from mcap_ros2.writer import Writer  # pyright: ignore[reportMissingImports]

    with path.open("wb") as file:
        writer = Writer(io.BytesIO())
        writer._writer = McapWriter(file, compression=CompressionType.ZSTD, enable_data_crcs=data_crcs)
        writer._writer.start(profile="ros2", library="torchcloth test")
        schema = writer.register_msgdef("geometry_msgs/msg/PoseStamped", POSE_MESSAGE_DEFINITION)
        for i in range(5):
            ns = FIRST_POSE_NS + 20_000_000 * i
            stamp = {"sec": ns // 10**9, "nanosec": ns % 10**9}
            x, y, z = gripper_position(i)
            pose = {"position": {"x": x, "y": y, "z": z}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
            message = {"header": {"stamp": stamp, "frame_id": "world"}, "pose": pose}
            writer.write_message("/hand", schema, message, log_time=ns, publish_time=ns, sequence=i)
        writer.finish()


if __name__ == "__main__":
    write_file(MCAP_FOLDER / "chunk_crcs.mcap", data_crcs=False)
    write_file(MCAP_FOLDER / "all_crcs.mcap", data_crcs=True)
