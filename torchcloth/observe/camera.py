"""A depth camera: the ray of a pixel, and the pixel of a point."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from ..errors import InvalidInput
from .lens import Lens

Array = np.ndarray


class Calibration(Protocol):
    """The calibration of a recorded camera, for example a ``recordings.Camera``."""

    @property
    def width(self) -> int:
        """Width of the images [px]."""
        ...

    @property
    def height(self) -> int:
        """Height of the images [px]."""
        ...

    @property
    def K(self) -> Array:
        """Intrinsic matrix [3, 3] px."""
        ...

    @property
    def T_world_camera(self) -> Array:
        """Pose [4, 4] m, camera to world."""
        ...

    @property
    def distortion(self) -> Array:
        """Coefficients [N] in OpenCV's order."""
        ...


@dataclass(frozen=True, eq=False)
class DepthCamera:
    """A depth camera in the OpenCV convention (x right, y down, z forward; pixel centres at integers).

    Attributes:
        width, height: pixels.
        K: [3, 3] intrinsic matrix, pixels.
        T_world_camera: [4, 4] camera to world, m.
        range: (nearest, farthest) depth that the camera reports, m; other pixels are 0.
        distortion: [0, 4, 5, 8, 12 or 14] coefficients of the lens in OpenCV's order (see `Lens`).

    Raises:
        InvalidInput: a size that is not positive, an intrinsic matrix that is not upper triangular with positive focal
            lengths, a pose that is not rigid, a range that is not increasing, or another number of coefficients.
    """

    width: int
    height: int
    K: Array
    T_world_camera: Array
    range: tuple[float, float] = (0.0, float("inf"))
    distortion: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        object.__setattr__(self, "distortion", self.lens.coefficients)
        object.__setattr__(self, "K", np.array(self.K, dtype=float))
        object.__setattr__(self, "T_world_camera", np.array(self.T_world_camera, dtype=float))
        if self.width < 1 or self.height < 1:
            raise InvalidInput(
                "camera size", got=f"{self.width} x {self.height}", expected="positive numbers of pixels"
            )
        K = self.K
        if (
            K.shape != (3, 3)
            or not np.isfinite(K).all()
            or not np.allclose(K[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1])
            or min(K[0, 0], K[1, 1]) <= 0
        ):
            raise InvalidInput(
                "K", got=K.tolist(), expected="[[fx, s, cx], [0, fy, cy], [0, 0, 1]] in pixels with fx, fy > 0"
            )
        _check_rigid(self.T_world_camera)
        if not 0 <= self.range[0] < self.range[1]:
            raise InvalidInput("range", got=self.range, expected="0 <= nearest < farthest, in m")

    @classmethod
    def from_recording(cls, recorded: Calibration, range: tuple[float, float] = (0.0, float("inf"))) -> DepthCamera:
        """Create the camera of a recording: ``DepthCamera.from_recording(recording.cameras["cam0"])``."""
        return cls(recorded.width, recorded.height, recorded.K, recorded.T_world_camera, range, recorded.distortion)

    @classmethod
    def azure_kinect_nfov(cls, T_world_camera: Array) -> DepthCamera:
        """Create the Azure Kinect DK's depth camera in NFOV unbinned mode: its raw image, strongly distorted.

        Size and range: Microsoft, "Azure Kinect DK hardware specifications" (640 x 576, 0.5 to 3.86 m). Lens: the
        factory calibration quoted in microsoft/Azure-Kinect-Sensor-SDK issue 1617, scaled to the 1024 px sensor and
        cropped by (192, 180) px as mode_specific_calibration.c does. That also subtracts half a pixel, because the
        factory counts from the corner of a pixel and OpenCV from its centre. Each device has its own calibration; this
        is one example of them. The mode's hexagonal mask is left out.

        Args:
            T_world_camera: [4, 4] camera to world, m.
        """
        sensor = 1024 * np.array([0.49203813, 0.49193162, 0.50147575, 0.49704871])
        fx, fy, cx, cy = sensor - [0.0, 0.0, 192.5, 180.5]
        k = (4.72473669, 3.20922279, 0.17059645, 5.05585957, 4.77578020, 0.88649416)
        p1, p2 = 5.87981e-6, 1.238212e-4  # the factory's order is p2, p1
        K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        return cls(640, 576, K, T_world_camera, (0.5, 3.86), np.array([k[0], k[1], p1, p2, *k[2:]]))

    @classmethod
    def realsense_d435(cls, T_world_camera: Array) -> DepthCamera:
        """Create a RealSense D435's depth camera at 848 x 480, its best resolution; the camera rectifies its images.

        Focal length: as one device reports it (realsense-ros issue 2788: 424.23 px, 89.97 degrees across). Only the
        column of that device's principal point is quoted (423.4 px); the row is put at mid-height. Range: about 0.2 m,
        where the search for 126 px of disparity ends (f b / 126 = 0.17 m), to 10 m (Intel, "RealSense D400 series
        datasheet").

        Args:
            T_world_camera: [4, 4] camera to world, m.
        """
        K = np.array([[424.229, 0.0, 423.426], [0.0, 424.229, 239.5], [0.0, 0.0, 1.0]])
        return cls(848, 480, K, T_world_camera, (0.2, 10.0))

    def to_calibration(self) -> dict[str, Any]:
        """Return what a recording stores: ``recordings.Camera(**camera.to_calibration(), depth_scale=0.001)``."""
        return {name: getattr(self, name) for name in ("width", "height", "K", "T_world_camera", "distortion")}

    def without_distortion(self) -> DepthCamera:
        """Return the same camera with an ideal lens."""
        return replace(self, distortion=np.zeros(0))

    @cached_property
    def lens(self) -> Lens:
        """Distortion model of the lens."""
        return Lens(self.distortion)

    def project(self, points: Array) -> tuple[Array, Array]:
        """Return pixel coordinates [..., 2] (column, row) and depths [...] m of world points [..., 3] m.

        A depth <= 0 is behind the camera. Pixels are NaN beyond the end of the lens model.
        """
        local = (np.asarray(points, dtype=float) - self.T_world_camera[:3, 3]) @ self.T_world_camera[:3, :3]
        z = local[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.lens.is_identity:
                image = local @ self.K.T
                return image[..., :2] / image[..., 2:], z
            distorted = self.lens.distort(local[..., :2] / z[..., None])
        return distorted @ self.K[:2, :2].T + self.K[:2, 2], z

    def unproject(self, pixels: Array, depth: Array) -> Array:
        """Return world points [..., 3] m of pixel coordinates [..., 2] (column, row) at depths [...] m.

        Depth is along the optical axis. Points are NaN where the lens model has no ray.
        """
        return self._place(self._rays(np.asarray(pixels, dtype=float)), np.asarray(depth, dtype=float))

    def rays(self) -> tuple[Array, Array]:
        """Return the origin [3] m and directions [H, W, 3] of all pixels, in the world.

        A direction is scaled such that its parameter is the depth in m. It is NaN where the lens model has no ray.
        """
        origin = self.T_world_camera[:3, 3]
        return origin, self._place(self.pixel_rays, np.ones((self.height, self.width))) - origin

    @cached_property
    def pixel_rays(self) -> Array:
        """Rays [H, W, 2] (x / z, y / z) of the pixels in the camera's axes; NaN where the lens model has none."""
        columns, rows = np.meshgrid(np.arange(self.width), np.arange(self.height))
        return self._rays(np.stack([columns, rows], -1).astype(float))

    def unproject_pixels(self, rows: Array, columns: Array, depth: Array) -> Array:
        """Return world points [N, 3] m of integer pixels at depths [N] m; NaN where the lens model has no ray."""
        return self._place(self.pixel_rays[rows, columns], np.asarray(depth, dtype=float))

    def _rays(self, pixels: Array) -> Array:
        y = (pixels[..., 1] - self.K[1, 2]) / self.K[1, 1]
        x = (pixels[..., 0] - self.K[0, 2] - self.K[0, 1] * y) / self.K[0, 0]
        return self.lens.undistort(np.stack([x, y], -1))

    def _place(self, rays: Array, depth: Array) -> Array:
        local = np.concatenate([rays * depth[..., None], depth[..., None]], -1)
        return local @ self.T_world_camera[:3, :3].T + self.T_world_camera[:3, 3]


def look_at(eye: Array, target: Array, up: Array = (0.0, 0.0, 1.0)) -> Array:  # type: ignore[assignment]
    """Return the camera-to-world pose [4, 4] of a camera at ``eye`` [3] m that looks at ``target`` [3] m.

    Args:
        eye: [3] m, place of the camera.
        target: [3] m, point in the centre of the image.
        up: [3], direction that is upwards in the image.

    Raises:
        InvalidInput: the target is at the eye, straight along ``up``, or not finite.
    """
    eye, target, up = (np.asarray(a, dtype=float) for a in (eye, target, up))
    forward = target - eye
    distance = np.linalg.norm(forward)
    right = np.cross(forward, up) if np.isfinite(distance) else np.zeros(3)
    if not (distance >= 1e-9 and np.linalg.norm(right) >= 1e-9 * distance):
        raise InvalidInput(
            "target",
            got=target.tolist(),
            expected="a finite point away from the eye and not along up",
            remedy="give another up",
        )
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    pose[:3, 3] = eye
    return pose


def _check_rigid(T: Array) -> None:
    if T.shape != (4, 4) or not np.allclose(T[3], [0, 0, 0, 1]) or not np.isfinite(T).all():
        raise InvalidInput("T_world_camera", got=f"shape {T.shape}", expected="[4, 4], finite, last row 0 0 0 1")
    R = T[:3, :3]
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-6) or np.linalg.det(R) < 0:
        raise InvalidInput(
            "T_world_camera", got="a matrix that is not a rotation", expected="an orthonormal right-handed rotation"
        )
