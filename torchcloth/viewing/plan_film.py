"""Film of a planned motion, the recorded motion and the goal."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..planning import Goal, MotionPlan
from .film import TRUTH_COLOUR, ClothSurface, Cloud, Film
from .recording_film import film_from_recording


def film_from_plan(plan: MotionPlan, goal: Goal) -> Film:
    """Make a film of the cloth under the planned motion and, as an outline, under the recorded motion.

    The goal's points are in every frame.
    """
    times, faces = plan.times.numpy(), plan.faces.numpy()
    film = film_from_recording(plan.recording, times=times)
    before, after = (1e3 * sum(each) / len(each) for each in (plan.distance_before, plan.distance_after))
    sheets = {
        "recorded motion": ClothSurface(
            plan.frames_before.numpy().astype(np.float32), faces, colour=TRUTH_COLOUR, outline=True
        ),
        "planned motion": ClothSurface(plan.frames.numpy().astype(np.float32), faces),
    }
    points = goal.points.numpy().astype(np.float32)
    return replace(
        film,
        title=f"{before:.1f} mm from the goal as recorded (outline), {after:.1f} mm as planned",
        sheets=sheets,
        clouds={"goal": Cloud(tuple(points for _ in times))},
    )
