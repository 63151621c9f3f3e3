"""The points of the cloth in the depth images of a bench."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from ..errors import InvalidInput
from ..observe import DepthCamera, Segmentation, SegmentedCloud, build_solid_meshes, segment_depth
from ..recordings import Collider, PointClouds, Recording
from ..robots import Arm  # pyright: ignore[reportMissingImports] - mapped from robots/ at installation
from .bench_files import depth_stream, load_depth

SPACINGS_PER_SIDE = 40  # of the thinned points, along the side of a square of the sheet's area
REACH_MARGIN_M = 0.03  # beyond the farthest corner of the sheet from a gripper
MIN_TABLE_FRACTION = 0.05  # of the points of the first image; a plane of fewer is a hem rather than a table
MIN_CLOUD_FRACTION = 0.1  # of the median number of points; an image with less lost the cloth
MIN_CUT_POINTS = 20  # of an image
TRIED_IMAGES = 3  # to see whether the grippers touch the cloth


class ClothCutter:
    """Cuts the cloth out of the images of a recording.

    Args:
        recording: with cameras, joints, clock and grasps.
        arms: by name of the gripper.
        reach: by name, m, farthest place of the sheet from the gripper.
    """

    def __init__(self, recording: Recording, arms: dict[str, Arm], reach: dict[str, float]) -> None:
        self.recording, self.arms, self.reach = recording, arms, reach
        (self.camera,) = recording.cameras.values()
        self.times = depth_stream(self.camera).t
        self.view = DepthCamera.from_recording(self.camera)
        width, height = recording.cloth.sheet or (0.0, 0.0)
        self.settings = Segmentation(spacing=round(np.sqrt(width * height) / SPACINGS_PER_SIDE, 4))
        self.is_touched = True
        self.notes: list[str] = []

    def bodies_at(self, time: float) -> tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray]:
        """Return the solids of the arms, and the places of the grippers [G, 3] m, at a time of the images [s]."""
        motion_time = time + self.recording.clock_offset
        solids, places = [], []
        for name, arm in self.arms.items():
            joints = self.recording.joints[name]
            q = torch.tensor([np.interp(motion_time, joints.t, angle) for angle in joints.q.T])
            solids += build_solid_meshes(arm.geometry(q))
            places.append(arm(q)[:3, 3].numpy())
        return solids, np.array(places)

    def segment(self, image: int) -> SegmentedCloud:
        """Return the cloth of one image."""
        solids, places = self.bodies_at(float(self.times[image]))
        reach = np.array(list(self.reach.values()))[:, None]
        low, high = (places - reach).max(0), (places + reach).min(0)
        if not (low < high).all():
            remedy = "check --base, --tool and the joints"
            raise InvalidInput("grippers", got="too far apart for the sheet", remedy=remedy)
        settings = replace(self.settings, workspace_low=tuple(low), workspace_high=tuple(high))
        grasps = places if self.is_touched else None
        return segment_depth(self.view, load_depth(self.camera, image), settings, robot=solids, grasps=grasps)

    def find_table(self) -> dict[str, Collider]:
        """Find a table in reach of the cloth in the first image; its points are cut off from then on."""
        settings = self.settings
        self.settings = replace(settings, table="find", outlier_neighbours=None, cluster_gap=None)
        result = self.segment(0)
        share = result.removed.get("table", 0) / max(1, result.input_count - result.removed["crop"])
        self.settings = settings
        if result.table is None or share < MIN_TABLE_FRACTION:
            return {}
        a, b, c, d = result.table.tolist()
        self.settings = replace(settings, table=(a, b, c, d))
        normal = np.array([a, b, c])
        self.notes.append(f"table: a level plane at z = {-d / c:.3f} m in the first image; the cloth cannot enter it")
        return {"table": Collider(-d * normal, normal)}

    def cut(self, on_image: Callable[[], None]) -> PointClouds:
        """Return the points of the cloth in all images that show it.

        Raises:
            InvalidInput: most images show no cloth.
        """
        t = self.times
        tried = np.unique(np.linspace(0, len(t) - 1, TRIED_IMAGES).astype(int))
        if all(len(self.segment(int(i)).points) < MIN_CUT_POINTS for i in tried):
            self.is_touched = False
            self.notes.append("cloth: the largest thing in reach of the gripper, which touches nothing")
        clouds = []
        for i in range(len(t)):
            clouds.append(self.segment(i).points)
            on_image()
        counts = np.array([len(cloud) for cloud in clouds])
        shows = counts >= max(MIN_CUT_POINTS, MIN_CLOUD_FRACTION * float(np.median(counts)))
        if shows.mean() < 0.5:
            raise InvalidInput(
                "depth images",
                got=f"no cloth in {int((~shows).sum())} of {len(t)} images",
                expected="points within reach of the gripper that are no arm and no table",
                remedy="check the camera's pose, --tool, --base and --sheet",
            )
        if not shows.all():
            self.notes.append(f"images: {int((~shows).sum())} of {len(t)} show no cloth and are left out")
        xyz = np.concatenate([cloud for cloud, use in zip(clouds, shows, strict=True) if use])
        self.notes.append(
            f"cloth: {int(counts[shows].min())} to {int(counts[shows].max())} points in an image, one in each cube of "
            f"{1e3 * (self.settings.spacing or 0):.0f} mm; cut out within reach of the gripper, without the arms"
        )
        return PointClouds(t[shows], xyz, counts[shows])


def farthest_corner(sheet: tuple[float, float], place: np.ndarray) -> float:
    """Return the reach [m] of a sheet (width, height) that is held at a pattern place [2] m, with a margin."""
    corners = np.array([[u, v] for u in (0.0, sheet[0]) for v in (0.0, sheet[1])])
    return float(np.linalg.norm(corners - place, axis=1).max()) + REACH_MARGIN_M
