"""The pose of a recording's camera, from the arms in its view."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from scipy.stats import chi2

from ..errors import InvalidInput
from ..observe import CameraPose, DepthCamera, decode_depth, find_camera_pose
from ..recordings import Camera, Recording
from ..robots.replay import arm_from_recording, unwrap_joints  # pyright: ignore[reportMissingImports] - from robots/

MAX_IMAGES = 10  # postures that differ most
MAX_AGREEMENT_P_VALUE = 0.001  # below which two poses differ
JOINT_OFFSET_STD_RAD = np.deg2rad(0.2)  # of an encoder's zero, before the fit
LAG_STD_S = 0.05  # of the images behind the joints, before the fit

Array = np.ndarray
ArmFunction = Callable[[Array], Sequence[Any]]


def find_camera_pose_from_arms(
    recording: Recording, name: str | None = None, start: Array | None = None, *, images: int = MAX_IMAGES
) -> CameraPose:
    """Find the pose of a depth camera from the arms in its view; see ``observe.find_camera_pose``.

    The unknowns of the arm (``CameraPose.arm``) are the time by which images come late [s], then the offset of each
    joint (rad or m), arm by arm.

    Args:
        recording: with joints, the robots that they belong to, and depth images.
        name: of the camera; None: the only one with depth.
        start: [4, 4] a rough pose, also tried; the pose in the recording does not count.
        images: number of images that are used: those whose postures differ most.

    Raises:
        InvalidInput: no such camera, no joints at the times of its images, or a pose that the images do not tell.
        RecordingError: an image cannot be decoded, or joints of no robot.
    """
    camera = _choose_camera(recording, name)
    stream, scale = camera.depth, camera.depth_scale
    if stream is None or scale is None:
        raise InvalidInput("camera", got="depth images without a scale", expected="metres per unit: depth_scale")
    arms = [arm_from_recording(recording, arm) for arm in recording.joints]
    logs = zip(arms, recording.joints.values(), strict=True)
    motions = [(joints.t, unwrap_joints(arm, joints.q)) for arm, joints in logs]
    times = np.asarray(stream.t) + recording.clock_offset
    is_covered = np.ones(len(times), bool)
    for t, _ in motions:
        is_covered &= (times >= t[0]) & (times <= t[-1])
    if not motions or not is_covered.any():
        got = "no joints" if not motions else "joints at other times than the images"
        raise InvalidInput("joints", got=got, expected="joint angles of an arm while the camera sees it")
    covered = np.flatnonzero(is_covered)
    postures = np.concatenate([_interpolate(times[covered], t, q) for t, q in motions], axis=1)
    chosen = covered[_select_different(postures, images)]
    depths = np.stack([decode_depth(stream.load(int(i)), scale) for i in chosen])
    arm, arm_std = make_arm_function(arms, motions, times[chosen])
    return find_camera_pose(DepthCamera.from_recording(camera), depths, arm, arm_std, start=start)


def describe_camera_pose(pose: CameraPose, recorded: Array | None) -> str:
    """Return a sentence with a pose from the arm, its standard errors, and how far a recorded pose [4, 4] lies off."""
    text = describe_pose_errors(pose)
    if recorded is not None:
        off = pose.compare(recorded)
        p_value = chi2.sf(off @ np.linalg.solve(pose.covariance, off), len(off))
        verdict = "more than errors explain" if p_value < MAX_AGREEMENT_P_VALUE else "within the errors"
        text += f"; the recorded pose is {1e3 * np.linalg.norm(off[:3]):.1f} mm and "
        text += f"{np.rad2deg(np.linalg.norm(off[3:])):.2f} degrees off, {verdict}"
    text += f"; T_world_camera {np.round(pose.T_world_camera, 4).tolist()}"
    return text if pose.is_determined else f"the images do not determine the {text}"


def describe_pose_errors(pose: CameraPose) -> str:
    """Return a phrase with the standard errors of a pose from the arm."""
    position, turn = 1e3 * np.linalg.norm(pose.position_std), np.rad2deg(np.linalg.norm(pose.rotation_std))
    return f"pose from the arm, to {position:.1f} mm and {turn:.2f} degrees"


def make_arm_function(
    arms: Sequence[Any], motions: Sequence[tuple[Array, Array]], times: Array
) -> tuple[ArmFunction, Array]:
    """Return solids at the images as a function of the arms' unknowns, and standard deviations of these.

    Args:
        arms: of the robots.
        motions: for each arm, times [K] s and joints [K, J].
        times: [T] s, of the images.

    Returns:
        The function of a lag of the images [s] and offsets of all joints, [1 + J + ...], and their standard deviations.
    """

    def place(unknowns: Array) -> list[Any]:
        solids, offsets = [], np.split(unknowns[1:], np.cumsum([q.shape[1] for _, q in motions])[:-1])
        for arm, (t, q), offset in zip(arms, motions, offsets, strict=True):
            joints = _interpolate(times - unknowns[0], t, q) + offset
            solids += arm.geometry(torch.as_tensor(joints))
        return solids

    return place, np.concatenate([[LAG_STD_S], np.full(sum(q.shape[1] for _, q in motions), JOINT_OFFSET_STD_RAD)])


def _interpolate(times: Array, t: Array, q: Array) -> Array:
    return np.stack([np.interp(times, t, column) for column in q.T], axis=-1)


def _select_different(postures: Array, count: int) -> Array:
    """Indices, in order, of postures [T, J] that lie farthest from each other, one after the other."""
    chosen = [0]
    distance = np.full(len(postures), np.inf)
    while len(chosen) < min(count, len(postures)):
        distance = np.minimum(distance, np.linalg.norm(postures - postures[chosen[-1]], axis=1))
        chosen.append(int(distance.argmax()))
    return np.unique(chosen)


def _choose_camera(recording: Recording, name: str | None) -> Camera:
    cameras = {key: camera for key, camera in recording.cameras.items() if camera.depth is not None}
    if name is None and len(cameras) == 1:
        return next(iter(cameras.values()))
    if name not in cameras:
        got = f"{len(cameras)} cameras with depth images" if name is None else repr(name)
        expected = f"one of {', '.join(cameras)}" if cameras else "a camera with depth images"
        raise InvalidInput("camera", got=got, expected=expected)
    return cameras[name]
