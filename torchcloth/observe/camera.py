"""A pinhole depth camera: where a pixel looks, and where a point falls."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import InvalidInput

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class DepthCamera:
    """A depth camera without lens distortion, in the OpenCV convention (x right, y down, z forward; pixel centres at
    integers).

    Attributes:
        width, height: pixels.
        K: [3, 3] intrinsic matrix, pixels.
        T_world_camera: [4, 4] camera to world, m.
        range: (nearest, farthest) depth that the camera reports, m; other pixels are 0.

    Raises:
        InvalidInput: a size that is not positive, an intrinsic matrix that is not upper triangular with positive focal
            lengths, a pose that is not rigid, or a range that is not increasing.
    """

    width: int
    height: int
    K: Array
    T_world_camera: Array
    range: tuple[float, float] = (0.0, float("inf"))

    def __post_init__(self) -> None:
        object.__setattr__(self, "K", np.array(self.K, dtype=float))
        object.__setattr__(self, "T_world_camera", np.array(self.T_world_camera, dtype=float))
        if self.width < 1 or self.height < 1:
            raise InvalidInput(
                "camera size", got=f"{self.width} x {self.height}", expected="positive numbers of pixels"
            )
        K = self.K
        if (
            K.shape != (3, 3)
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
    def azure_kinect_nfov(cls, T_world_camera: Array) -> DepthCamera:
        """The Azure Kinect DK's depth camera in NFOV unbinned mode, undistorted.

        Size and range: Microsoft, "Azure Kinect DK hardware specifications" (640 x 576, 0.5 to 3.86 m). Focal length
            and principal
        point: the factory calibration quoted in microsoft/Azure-Kinect-Sensor-SDK issue 1617 (0.492 and 0.5 of the
            1024 px sensor),
        with the crop of (192, 180) px of this mode. Each device has its own calibration; this is one example of them.

        Args:
            T_world_camera: [4, 4] camera to world, m.
        """
        K = np.array([[503.8, 0.0, 321.5], [0.0, 503.8, 329.0], [0.0, 0.0, 1.0]])
        return cls(640, 576, K, T_world_camera, (0.5, 3.86))

    def project(self, points: Array) -> tuple[Array, Array]:
        """Pixel coordinates [..., 2] (column, row) and depth [...] m of world points [..., 3] m; depth <= 0 is
        behind the camera.
        """
        local = (np.asarray(points, dtype=float) - self.T_world_camera[:3, 3]) @ self.T_world_camera[:3, :3]
        z = local[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            image = local @ self.K.T
            return image[..., :2] / image[..., 2:], z

    def unproject(self, pixels: Array, depth: Array) -> Array:
        """World points [..., 3] m of pixel coordinates [..., 2] (column, row) at depths [...] m along the optical
        axis.
        """
        pixels, depth = np.asarray(pixels, dtype=float), np.asarray(depth, dtype=float)
        y = (pixels[..., 1] - self.K[1, 2]) / self.K[1, 1]
        x = (pixels[..., 0] - self.K[0, 2] - self.K[0, 1] * y) / self.K[0, 0]
        local = np.stack([x * depth, y * depth, depth], -1)
        return local @ self.T_world_camera[:3, :3].T + self.T_world_camera[:3, 3]

    def rays(self) -> tuple[Array, Array]:
        """Origin [3] m and directions [H, W, 3], world; a direction's length is such that its parameter is the depth
        in m.
        """
        columns, rows = np.meshgrid(np.arange(self.width), np.arange(self.height))
        origin = self.T_world_camera[:3, 3]
        return origin, self.unproject(np.stack([columns, rows], -1), np.ones((self.height, self.width))) - origin


def look_at(eye: Array, target: Array, up: Array = (0.0, 0.0, 1.0)) -> Array:  # type: ignore[assignment]
    """Camera-to-world pose [4, 4] of a camera at ``eye`` [3] m that looks at ``target`` [3] m with ``up`` [3] upwards
    in the image.

    Raises:
        InvalidInput: the target is at the eye, or straight along ``up``.
    """
    eye, target, up = (np.asarray(a, dtype=float) for a in (eye, target, up))
    forward = target - eye
    right = np.cross(forward, up)
    if np.linalg.norm(forward) < 1e-9 or np.linalg.norm(right) < 1e-9 * np.linalg.norm(forward):
        raise InvalidInput(
            "target",
            got=target.tolist(),
            expected="a point away from the eye and not along up",
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
