"""Picture of a new episode: the first image with arm and cloth, and the sheet with what holds it."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from ..observe import DepthCamera
from ..recordings import Recording
from ..robots import Arm  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation

CLOTH_COLOUR, ARM_COLOUR, SHAPE_COLOUR = "#1f6f8b", "#b0653a", "#d8c27a"
NOTE_CHARACTERS = 170  # of a line below the panels


def draw(
    recording: Recording,
    image: np.ndarray,
    arms: dict[str, Arm],
    solids: Sequence[tuple[np.ndarray, np.ndarray]],
    notes: Sequence[str],
) -> Any:
    """Return a matplotlib figure.

    Args:
        recording: with points.
        image: [H, W] m, depth at the first cloud.
        arms: by name of the gripper.
        solids: of the arms at the first cloud, as vertices [V, 3] m and triangles.
        notes: what was guessed, written below.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 6.5))
    left, right = figure.subplots(1, 2, width_ratios=[1.6, 1])
    figure.subplots_adjust(bottom=0.12)
    _draw_image(left, recording, image, arms, solids)
    _draw_sheet(right, recording)
    lines = [line for note in notes for line in textwrap.wrap(note, NOTE_CHARACTERS, subsequent_indent="    ")]
    figure.text(0.08, 0.04, "\n".join(lines), fontsize=7, va="top", family="monospace", parse_math=False)
    return figure


def _draw_image(
    axis: Any,
    recording: Recording,
    image: np.ndarray,
    arms: dict[str, Arm],
    solids: Sequence[tuple[np.ndarray, np.ndarray]],
) -> None:
    points = recording.require("points")
    view = DepthCamera.from_recording(next(iter(recording.cameras.values())))
    shown = axis.imshow(np.where(image > 0, image, np.nan), cmap="gray_r")
    axis.figure.colorbar(shown, ax=axis, shrink=0.6, label="depth [m]")
    limits = axis.get_xlim(), axis.get_ylim()
    for k, (vertices, faces) in enumerate(solids):
        pixels, depth = view.project(vertices)
        if (depth > 0).all() and np.isfinite(pixels).all():
            label = "arm" if k == 0 else None
            axis.triplot(*pixels.T, faces, color=ARM_COLOUR, linewidth=0.2, alpha=0.5, label=label)
    pixels, _ = view.project(points.frame(0))
    axis.plot(*pixels.T, ".", color=CLOTH_COLOUR, markersize=1.5, label="points of the cloth")
    cloth = recording.cloth
    if cloth.initial_vertices is not None and cloth.faces is not None:
        pixels, _ = view.project(cloth.initial_vertices)
        axis.triplot(*pixels.T, cloth.faces, color=SHAPE_COLOUR, linewidth=0.4, label="first shape")
    for name, arm in arms.items():
        joints, time = recording.joints[name], points.t[0] + recording.clock_offset
        q = torch.tensor([np.interp(time, joints.t, angle) for angle in joints.q.T])
        links, _ = view.project(np.vstack([arm.body_poses(q)[:, :3, 3].numpy(), arm(q)[:3, 3].numpy()]))
        axis.plot(*links.T, "-", color=ARM_COLOUR, linewidth=1.5)
        axis.plot(*links[-1], "x", color=ARM_COLOUR, markersize=10, markeredgewidth=2)
        axis.annotate(name, links[-1], xytext=(6, 6), textcoords="offset points", fontsize=9, parse_math=False)
    axis.set(xlim=limits[0], ylim=limits[1], xlabel="column [px]", ylabel="row [px]")
    axis.set_title(f"first image, {points.t[0]:.2f} s", fontsize=10)
    axis.legend(fontsize=8, loc="lower right")


def _draw_sheet(axis: Any, recording: Recording) -> None:
    box = recording.cloth.pattern_box()
    assert box is not None
    width, height = box[1] - box[0]
    axis.plot([0, width, width, 0, 0], [0, 0, height, height, 0], color=CLOTH_COLOUR)
    for name, grasp in recording.grasps.items():
        places = np.zeros((0, 2)) if grasp.uv is None else grasp.uv
        turn = np.linspace(0, 2 * np.pi, 40)
        for place in places:
            rim = place + grasp.radius * np.stack([np.cos(turn), np.sin(turn)], 1)
            axis.fill(*rim.T, color=ARM_COLOUR, linewidth=0)
        axis.annotate(name, places.mean(0), xytext=(8, -14), textcoords="offset points", fontsize=9, parse_math=False)
    axis.set(aspect="equal", xlabel="u [m]", ylabel="v [m]")
    axis.set_title("sheet, and what is held of it", fontsize=10)
