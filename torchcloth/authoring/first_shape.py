"""The first shape of a sheet that hangs from grippers, laid onto its first cloud."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..episodes.recorded_cloth import build_mesh
from ..errors import InvalidInput
from ..meshes import Mesh
from ..observe import align
from ..recordings import GraspInfo, Recording

ALIGNMENT_NOISE_M = (0.002, 0.005)  # of a time-of-flight camera, and of a stereo camera
GRIP_TOLERANCE_M = 0.005  # by which a place that is held may lie off the sheet or off an edge
MIN_LEVER_FRACTION = 0.1  # of the shorter side; a sheet held nearer to its middle hangs in folds
MIN_LEVEL_SINE = 0.2  # of the angle between the line through two grippers and the vertical


class SheetGrip(NamedTuple):
    """How a gripper holds a sheet.

    Attributes:
        place: [2] m, pattern place at the gripper's origin.
        grasp: the material that it holds.
        upwards: [2], direction on the pattern that hangs upwards; None: from the middle of the sheet to the place.
    """

    place: np.ndarray
    grasp: GraspInfo
    upwards: np.ndarray | None


def make_grip(sheet: tuple[float, float], place: tuple[float, float], is_bar: bool, radius: float) -> SheetGrip:
    """Return how a gripper, or a bar along an edge, holds a sheet (width, height) at a place (u, v) m.

    Raises:
        InvalidInput: a place off the sheet, or a bar at a place on no edge or in a corner.
    """
    uv, size = np.array(place, dtype=float), np.array(sheet, dtype=float)
    if not (np.isfinite(uv).all() and (uv >= -GRIP_TOLERANCE_M).all() and (uv <= size + GRIP_TOLERANCE_M).all()):
        expected = f"u from 0 to {size[0]:g} and v from 0 to {size[1]:g} m"
        raise InvalidInput("place that is held", got=f"({uv[0]:g}, {uv[1]:g})", expected=expected)
    uv = uv.clip(0.0, size)
    if not is_bar:
        return SheetGrip(uv, GraspInfo(uv[None], radius), None)
    distances = np.concatenate([uv, size - uv])  # from the edges u = 0, v = 0, u = width, v = height
    edges = np.flatnonzero(distances <= GRIP_TOLERANCE_M)
    if len(edges) != 1:
        got = f"({uv[0]:g}, {uv[1]:g}), {'in a corner' if len(edges) else 'on no edge'}"
        raise InvalidInput("place that a bar holds", got=got, expected="a place inside one edge, such as its middle")
    axis, is_high = int(edges[0]) % 2, edges[0] >= 2
    count = max(2, int(np.ceil(2 * size[1 - axis] / radius)) + 1)
    points = np.empty((count, 2))
    points[:, axis], points[:, 1 - axis] = size[axis] if is_high else 0.0, np.linspace(0.0, size[1 - axis], count)
    upwards = np.zeros(2)
    upwards[axis] = 1.0 if is_high else -1.0
    return SheetGrip(uv, GraspInfo(points, radius), upwards)


def lay_first_shape(recording: Recording, grips: Sequence[SheetGrip], places: np.ndarray) -> tuple[Recording, str]:
    """Return the recording with the shape of the cloth at its first cloud, and what is known of that shape.

    Args:
        recording: with points, grasps and a camera.
        grips: of the grippers.
        places: [G, 3] m, of the grippers at the first cloud.
    """
    mesh = build_mesh(replace(recording, grasps={}))
    cloud = recording.require("points").frame(0)
    eye = next(iter(recording.cameras.values())).T_world_camera[:3, 3]
    # a sheet looks the same with its sides exchanged, and only the grippers tell which corner is whose
    held_vertices = [int(np.linalg.norm(np.asarray(mesh.uv) - grip.place, axis=1).argmin()) for grip in grips]
    starts = hanging_shapes(mesh, grips, places, cloud)
    results, refusal = [], ""
    for noise in ALIGNMENT_NOISE_M:
        for start in starts:
            try:
                results.append(align(mesh, cloud, start=start, viewpoint=eye, noise=noise, held_vertices=held_vertices))
            except InvalidInput as error:
                refusal = str(error)
        if results:
            break
    if not starts:
        return recording, "first shape: unknown, since the sheet is held in its middle; give it by --network"
    if results:
        best = min(results, key=lambda one: one.rms)
        x = best.x.numpy()
        text = f"laid onto the first cloud, {1e3 * best.rms:.1f} mm from it"
        if len(starts) > 1:
            text += "; which side faces the camera is a guess"
    else:
        x, text = (
            starts[0],
            f"hangs straight from the grippers, as it could not be laid onto the first cloud ({refusal})",
        )
    cloth = replace(recording.cloth, vertices=mesh.vertices, faces=mesh.faces, uv=mesh.uv, initial_vertices=x)
    return replace(recording, cloth=cloth), f"first shape: {text}"


def hanging_shapes(mesh: Mesh, grips: Sequence[SheetGrip], places: np.ndarray, cloud: np.ndarray) -> list[np.ndarray]:
    """Return the shapes [V, 3] m that a flat sheet may have when it hangs from its grippers.

    Args:
        mesh: of the sheet.
        grips: of the grippers.
        places: [G, 3] m, of the grippers.
        cloud: [N, 3] m, points of the sheet, whose longest level direction is that of the sheet.

    Returns:
        One shape of a sheet in two grippers, two of a sheet in one, and none of one that is held in its middle.
    """
    uv = np.asarray(mesh.uv)
    low, high = uv.min(0), uv.max(0)
    centre, vertical = (low + high) / 2, np.array([0.0, 0.0, 1.0])
    held_places = np.array([grip.place for grip in grips])
    apart = np.linalg.norm(held_places[:, None] - held_places, axis=-1)
    if apart.max() > MIN_LEVER_FRACTION * (high - low).min():
        i, j = np.unravel_index(int(apart.argmax()), apart.shape)
        along, line = (held_places[j] - held_places[i]) / apart[i, j], places[j] - places[i]
        line = line / max(float(np.linalg.norm(line)), 1e-9)
        upwards = np.array([-along[1], along[0]])
        middle, place = (held_places[i] + held_places[j]) / 2, (places[i] + places[j]) / 2
        if upwards @ (centre - middle) > 0:
            upwards = -upwards
        up = vertical - line * line[2]
        if np.linalg.norm(up) < MIN_LEVEL_SINE:
            up = np.cross(line, _longest_level_direction(cloud))
        up = up / np.linalg.norm(up)
        return [place + ((uv - middle) @ along)[:, None] * line + ((uv - middle) @ upwards)[:, None] * up]
    (grip, *_), place = grips, places[0]
    upwards = grip.place - centre if grip.upwards is None else grip.upwards
    if np.linalg.norm(upwards) < MIN_LEVER_FRACTION * (high - low).min():
        return []
    upwards = upwards / np.linalg.norm(upwards)
    aside = (uv - grip.place) @ np.array([upwards[1], -upwards[0]])
    level = _longest_level_direction(cloud)
    hanging = place + ((uv - grip.place) @ upwards)[:, None] * vertical
    return [hanging + sign * aside[:, None] * level for sign in (1.0, -1.0)]


def _longest_level_direction(cloud: np.ndarray) -> np.ndarray:
    """Unit vector [3] of the longest level direction of a cloud."""
    offsets = cloud[:, :2] - cloud[:, :2].mean(0)
    axis = np.linalg.eigh(offsets.T @ offsets)[1][:, -1]
    return np.array([*axis, 0.0])
