"""A planned motion beside the recorded one, and the goal."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..planning import Goal, MotionPlan
from .film import TRUTH, Cloud, Film, Sheet
from .recording_film import film_of


def film_of_plan(plan: MotionPlan, goal: Goal) -> Film:
    """The cloth under the planned motion; as a net, under the recorded one; the goal's points in every frame."""
    times, faces = plan.times.numpy(), plan.faces.numpy()
    film = film_of(plan.recording, times=times)
    before, after = (1e3 * sum(each) / len(each) for each in (plan.distance_before, plan.distance_after))
    sheets = {
        "recorded motion": Sheet(plan.frames_before.numpy().astype(np.float32), faces, colour=TRUTH, net=True),
        "planned motion": Sheet(plan.frames.numpy().astype(np.float32), faces),
    }
    points = goal.points.numpy().astype(np.float32)
    return replace(
        film,
        title=f"{before:.1f} mm from the goal as recorded (net), {after:.1f} mm as planned",
        sheets=sheets,
        clouds={"goal": Cloud(tuple(points for _ in times))},
    )
