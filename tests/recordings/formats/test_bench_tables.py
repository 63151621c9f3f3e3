"""Tables of any logger, folders of depth images, and calibrations of other tools."""

import json
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from torchcloth.errors import RecordingError
from torchcloth.recordings.formats.calibration_files import read_intrinsics, read_pose
from torchcloth.recordings.formats.depth_folder import read_depth_folder
from torchcloth.recordings.formats.joint_log import JointNames, read_joint_log

Q = np.array([[0.1, -0.5], [0.2, -0.6], [0.3, -0.7], [0.4, -0.8]])
SECONDS = np.array([10.0, 10.01, 10.02, 10.03])
JOINTS = JointNames(("arm_joint1", "arm_joint2"), np.zeros(2, bool), np.full(2, -2.0), np.full(2, 2.0))


def write(folder: Path, *lines: str) -> Path:
    path = folder / "table.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def rows(template: str, q: np.ndarray = Q) -> list[str]:
    """Return a line for each sample; {t}, {ms}, {ns}, {a} and {b} stand for its numbers."""
    return [
        template.format(t=t, ms=round(1e3 * t), s=int(t), part=round(1e9 * (t % 1)), ns=round(1e9 * t), a=a, b=b)
        for t, (a, b) in zip(SECONDS.tolist(), q.tolist(), strict=True)
    ]


@pytest.mark.parametrize(
    "lines",
    [
        rows("{t},{a},{b}"),
        rows("{ms} {a} {b}"),
        ["# time q1 q2", *rows("{t} {a} {b}")],
        ["time_ms;q1;q2", *[line.replace(".", ",") for line in rows("{ms};{a};{b}")]],
        ["arm_joint2,arm_joint1,timestamp", *rows("{b},{a},{t}")],
        ["__time,/s/arm_joint1/velocity,/s/arm_joint1/position,/s/arm_joint2/position", *rows("{t},9,{a},{b}")],
        ["%time,field.header.stamp,field.name0,field.name1,field.position0,field.position1,field.velocity0,field.velocity1",
         *rows("7{ns},{ns},x,y,{a},{b},8,9")],
        ["stamp.sec,stamp.nanosec,actual_q_0,actual_q_1,target_q_0,target_q_1", *rows("{s},{part},{a},{b},5,6")],
        ["\ufefft [us],q1 [deg],q2 [deg]", *rows("{ms}000,{a},{b}", np.degrees(Q))],
    ],
    ids=["bare", "blanks", "savetxt", "decimal commas", "by name", "PlotJuggler", "rostopic", "two columns", "units"],
)  # fmt: skip
def test_joint_logs_of_all_kinds_say_the_same(tmp_path, lines):
    log = read_joint_log(write(tmp_path, *lines), JOINTS)
    np.testing.assert_allclose(log.q, Q, atol=1e-12)
    np.testing.assert_array_equal(log.ns, np.round(1e9 * SECONDS).astype(int))


@pytest.mark.parametrize(("digits", "unit"), [(0, "seconds"), (3, "milliseconds"), (6, "micro"), (9, "nano")])
def test_the_unit_of_epoch_stamps_is_guessed_from_their_steps(tmp_path, digits, unit):
    stamps = [f"{Decimal(171400000000 + k).scaleb(digits - 2):f}" for k in range(4)]
    log = read_joint_log(write(tmp_path, *[f"{t},0.1,0.2" for t in stamps]), JOINTS)
    assert unit in " ".join(log.notes)
    np.testing.assert_array_equal(np.diff(log.ns), 10_000_000)


def test_degrees_are_told_by_the_joints_limits(tmp_path):
    log = read_joint_log(write(tmp_path, *rows("{t},{a},{b}", np.degrees(Q))), JOINTS)
    np.testing.assert_allclose(log.q, Q)
    assert "degrees" in " ".join(log.notes)


def test_the_columns_of_an_arm_are_told_from_those_of_another_one(tmp_path):
    heads = "t,left/arm_joint1,left/arm_joint2,right/arm_joint1,right/arm_joint2"
    path = write(tmp_path, heads, *rows("{t},9,9,{a},{b}"))
    np.testing.assert_array_equal(read_joint_log(path, JOINTS._replace(arm="right")).q, Q)
    with pytest.raises(RecordingError, match="has several columns"):
        read_joint_log(path, JOINTS)


def test_rows_twice_out_of_order_or_cut_off_are_mended_and_said(tmp_path):
    lines = rows("{t},{a},{b}")
    log = read_joint_log(write(tmp_path, lines[1], lines[0], lines[0], *lines[2:], "10.0"), JOINTS)
    np.testing.assert_array_equal(log.q, Q)
    said = " ".join(log.notes)
    assert "cut off" in said
    assert "twice" in said
    assert "out of order" in said


def test_a_gripper_is_closed_where_a_column_says_so(tmp_path):
    lines = [f"{line},{word}" for line, word in zip(rows("{t},{a},{b}"), ("True", "true", "False", "0"), strict=True)]
    log = read_joint_log(write(tmp_path, "t,q1,q2,gripper_closed", *lines), JOINTS)
    assert log.closed is not None
    assert log.closed.tolist() == [True, True, False, False]


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (["nothing", "here"], "holds no table"),
        (rows("{t},{a}"), "does not hold the 2 joints"),
        (["t,elbow,wrist,hand", *rows("{t},{a},{b},1")], "name the columns as the URDF names the joints"),
        (rows("{t},{a},700"), "angles that the arm cannot take"),
        (["1,2,3", "2,3", "3,4,5"], "2 cells in row 2"),
        (["t,q1,q2", "1,nan,3", "2,3,4"], "column 'q1' of row 1"),
        (["1,2,3", "1,2,4"], "one value throughout"),
        (["1.0,0.2,0.3", "1.01,0.2,0.4", "1.01,0.2,0.5"], "two rows have one time"),
        (["1.0,0.2,0.3", "words", "1.1,0.2,0.3"], "is no table"),
        (["t,q1,q2", "1e400,2,3", "2,3,4"], "is no time"),
    ],
)  # fmt: skip
def test_tables_that_hold_no_joints_are_refused(tmp_path, lines, said):
    with pytest.raises(RecordingError, match=said):
        read_joint_log(write(tmp_path, *lines), JOINTS)


def write_images(folder: Path, names: list[str]) -> Path:
    (folder / "depth").mkdir()
    for name in names:
        Image.fromarray(np.full((3, 4), 1000, np.uint16)).save(folder / "depth" / f"{name}.png")
    return folder / "depth"


@pytest.mark.parametrize(
    ("names", "file", "text"),
    [
        (["5000000000", "5040000000", "5080000000", "5120000000"], None, ""),
        (["5.00", "5.04", "5.08", "5.12"], None, ""),
        (["0001-005000000", "0002-005040000", "0003-005080000", "0004-005120000"], None, ""),
        (["0", "1", "2", "10"], "times.txt", "5.00\n5.04\n5.08\n5.12\n"),
        (["a1", "a2", "a3", "a4"], "depth/timestamps.csv", "i,t_color,t_depth\n0,1,5.00\n1,2,5.04\n2,3,5.08\n3,4,5.12"),
        (["a1", "a2", "a3", "a4"], "depth.txt", "# timestamp filename\n" + "".join(
            f"{t} depth/{name}.png\n" for t, name in (("5.12", "a4"), ("5.00", "a1"), ("5.04", "a2"), ("5.08", "a3")))),
    ],
    ids=["ns in names", "s in names", "Redwood", "list", "csv with depth", "TUM"],
)  # fmt: skip
def test_times_of_images_are_read_from_names_and_tables(tmp_path, names, file, text):
    folder = write_images(tmp_path, names)
    if file is not None:
        (tmp_path / file).write_text(text)
    images = read_depth_folder(folder)
    np.testing.assert_array_equal(images.ns - images.ns[0], [0, 40_000_000, 80_000_000, 120_000_000])
    assert len(images.notes) > 0


def test_frame_numbers_need_the_images_per_second(tmp_path):
    folder = write_images(tmp_path, ["000001", "000002", "000003", "000005"])
    with pytest.raises(RecordingError, match="--fps"):
        read_depth_folder(folder)
    np.testing.assert_array_equal(read_depth_folder(folder, fps=25).ns, [0, 40_000_000, 80_000_000, 160_000_000])


@pytest.mark.parametrize(
    ("text", "said"), [("1\n2\n3\n", "3 times of 4 images"), ("1\n1\n2\n3\n", "two images have one time")]
)
def test_tables_of_times_that_do_not_fit_are_refused(tmp_path, text, said):
    (tmp_path / "times.csv").write_text(text)
    with pytest.raises(RecordingError, match=said):
        read_depth_folder(write_images(tmp_path, ["1", "2", "3", "4"]))


FLAT_MATRIX = [500.0, 0.0, 320.0, 0.0, 510.0, 240.0, 0.0, 0.0, 1.0]
MATRIX = [[500.0, 0.0, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]]


@pytest.mark.parametrize(
    "content",
    [
        {"fx": 500, "fy": 510, "cx": 320, "cy": 240},
        {"width": 640, "height": 480, "fx": 500, "fy": 510, "ppx": 320, "ppy": 240, "coeffs": [0] * 5, "model": "none"},
        MATRIX,
        {"K": MATRIX},
        {"width": 640, "height": 480, "k": FLAT_MATRIX, "d": [0.1, 0, 0, 0, 0], "distortion_model": "plumb_bob"},
        {"intrinsic_matrix": np.array(MATRIX).T.ravel().tolist(), "width": 640, "height": 480},
        {"camera_matrix": {"rows": 3, "cols": 3, "data": FLAT_MATRIX}, "image_width": 640, "image_height": 480},
        {"depth": {"fx": 500, "fy": 510, "cx": 320, "cy": 240}},
    ],
    ids=["four numbers", "RealSense", "matrix", "K", "CameraInfo", "Open3D", "OpenCV", "nested"],
)
def test_intrinsics_of_other_tools_are_read(tmp_path, content):
    path = tmp_path / "K.json"
    path.write_text(json.dumps(content))
    np.testing.assert_array_equal(read_intrinsics(path)["K"], MATRIX)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("fx: 500", "is no JSON"),
        ('{"a": 1}', "holds no camera matrix"),
        ("[[1, 2], [3, 4]]", "wrong shape"),
        ('{"K": [[500, 0, 320], [0, 510, 240], [1, 0, 1]]}', "holds no camera matrix"),
        ('{"fx": 5, "fy": 5, "cx": 3, "cy": 2, "d": [1, 0, 0, 0], "distortion_model": "equidistant"}', "lens model"),
        ('{"fx": 5, "fy": 5, "cx": 3, "cy": 2, "width": 0.5}', "whole number of pixels"),
        ("7", "wrong shape"),
        ('{"fx": "a", "fy": 5, "cx": 3, "cy": 2}', "wrong dtype"),
    ],
)
def test_files_without_usable_intrinsics_are_refused(tmp_path, text, said):
    (tmp_path / "K.json").write_text(text)
    with pytest.raises(RecordingError, match=said):
        read_intrinsics(tmp_path / "K.json")


@pytest.mark.parametrize(
    "text",
    [
        "0 -1 0 0.5\n1 0 0 0.1\n0 0 1 1.5\n0 0 0 1\n",
        "[[0, -1, 0, 0.5], [1, 0, 0, 0.1], [0, 0, 1, 1.5]]",
        "# x y z qx qy qz qw\n0.5 0.1 1.5 0 0 0.70710678 0.70710678\n",
    ],
)
def test_poses_are_read_as_matrices_and_quaternions(tmp_path, text):
    (tmp_path / "T.txt").write_text(text)
    expected = [[0, -1, 0, 0.5], [1, 0, 0, 0.1], [0, 0, 1, 1.5], [0, 0, 0, 1]]
    np.testing.assert_allclose(read_pose(tmp_path / "T.txt"), expected, atol=1e-8)


@pytest.mark.parametrize(
    ("text", "said"),
    [("1 2 3", "3 numbers"), ("one", "is no pose"), ("0 0 0 1 1 1 1", "not unit"), ("2 0 0 0 " * 4, "not a rotation")],
)
def test_files_without_a_pose_are_refused(tmp_path, text, said):
    (tmp_path / "T.txt").write_text(text)
    with pytest.raises(RecordingError, match=said):
        read_pose(tmp_path / "T.txt")
