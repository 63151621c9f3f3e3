"""Write a film as a file for rerun's viewer (``rerun FILE.rrd``)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .._utils.files import write_atomically
from ..errors import MissingDependency
from ..meshes.mesh import vertex_normals
from ..observe import DepthCamera, decode_depth, encode_depth, reproject
from ..observe.render import import_open3d
from .colours import map_colours
from .film import GRIPPER_AXES_LENGTH_M, CameraView, Film, GripperPath, RigidBody
from .geometry import Array, to_quaternions
from .projection import fit_camera

TIMELINE = "seconds from the first frame"
WORLD_ENTITY, CURVES_ENTITY = "world", "curves"
POINT_RADIUS_M = 0.0025
PATH_RADIUS_M = 0.0015
IMAGE_PLANE_DISTANCE_M = 0.15  # of a camera's frustum
RERUN_VIEW_SIZE_PX = (800, 600)
EYE_DISTANCE_FACTOR = 0.5  # rerun's lens is wider than that of pictures, so the eye must be nearer


def write_rrd(film: Film, path: str | Path) -> Path:
    """Write a film for rerun's viewer: shapes, curves and depth images on the timeline "seconds from the first frame".

    Depth images of a distorted lens are resampled to an ideal lens.

    Args:
        film: what to show.
        path: the file; it is written atomically.

    Returns:
        ``path``.

    Raises:
        MissingDependency: rerun-sdk is not installed.
    """
    rr = _rerun()
    with write_atomically(Path(path)) as part:
        part.touch()  # rerun's own error for an unwritable path does not name the file
        stream = rr.RecordingStream("torchcloth")
        stream.save(part, default_blueprint=_layout(film))
        stream.send_recording_name(film.title)
        stream.log(WORLD_ENTITY, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        _Writer(rr, stream, film).write()
        stream.flush()
        stream.disconnect()
    return Path(path)


class _Writer:
    """Sends each part in columns, with one message for all frames."""

    def __init__(self, rr: Any, stream: Any, film: Film) -> None:
        self.rr, self.stream, self.film = rr, stream, film

    def write(self) -> None:
        film, rr = self.film, self.rr
        for name in film.sheets:
            self._sheet(name)
        for name, cloud in film.clouds.items():
            self._static(name, rr.Points3D.from_fields(colors=[cloud.colour], radii=[POINT_RADIUS_M]))
            lengths = [len(points) for points in cloud.frames]
            self._columns(name, rr.Points3D.columns(positions=np.concatenate(cloud.frames)).partition(lengths))
        for name, solid in film.solids.items():
            self._solid(name, solid)
        for name, plane in film.planes.items():
            self._mesh(name, plane.corners, plane.FACES, plane.colour)
        for name, trace in film.traces.items():
            self._trace(name, trace)
        for name, view in film.views.items():
            self._view(name, view)
        for name, curve in film.curves.items():
            known = np.isfinite(curve.values)
            times = rr.TimeColumn(TIMELINE, duration=curve.t[known] - film.times[0])
            self.stream.send_columns(
                self._path(CURVES_ENTITY, name), [times], rr.Scalars.columns(scalars=curve.values[known])
            )
            self.stream.log(
                self._path(CURVES_ENTITY, name), rr.SeriesLines(names=f"{name} [{curve.unit}]"), static=True
            )

    def _path(self, root: str, name: str) -> str:
        return self.rr.new_entity_path([root, *name.split("/")])

    def _static(self, name: str, component: Any) -> None:
        self.stream.log(self._path(WORLD_ENTITY, name), component, static=True)

    def _columns(self, name: str, columns: Any) -> None:
        times = self.rr.TimeColumn(TIMELINE, duration=self.film.times - self.film.times[0])
        self.stream.send_columns(self._path(WORLD_ENTITY, name), [times], columns)

    def _sheet(self, name: str) -> None:
        sheet, count = self.film.sheets[name], len(self.film)
        x = sheet.vertices
        fields = {"vertex_positions": x.reshape(-1, 3)}
        if sheet.values is None:
            fixed = self.rr.Mesh3D.from_fields(triangle_indices=sheet.faces, albedo_factor=sheet.colour)
            normals = np.stack([vertex_normals(frame, sheet.faces) for frame in x])
            fields["vertex_normals"] = normals.astype(np.float32).reshape(-1, 3)
        else:  # without normals the mesh is not shaded, so its colours match the colour bar
            fixed = self.rr.Mesh3D.from_fields(triangle_indices=sheet.faces)
            fields["vertex_colors"] = map_colours(sheet.values, self.film.colour_limit).reshape(-1, 3)
        self._static(name, fixed)
        self._columns(name, self.rr.Mesh3D.columns(**fields).partition([x.shape[1]] * count))

    def _mesh(self, name: str, vertices: Array, faces: Array, colour: tuple[int, int, int]) -> None:
        flat = vertices[faces].reshape(-1, 3)  # separate corners for each triangle keep edges sharp
        index = np.arange(len(flat)).reshape(-1, 3)
        normals = vertex_normals(flat, index)
        self._static(
            name,
            self.rr.Mesh3D(vertex_positions=flat, triangle_indices=index, vertex_normals=normals, albedo_factor=colour),
        )

    def _solid(self, name: str, solid: RigidBody) -> None:
        self._mesh(name, solid.vertices, solid.faces, solid.colour)
        self._poses(name, solid.poses)

    def _poses(self, name: str, poses: Array) -> None:
        """Send poses; rerun's quaternions are xyzw."""
        xyzw = to_quaternions(poses[:, :3, :3])[:, [1, 2, 3, 0]]
        if len(poses) == len(self.film):
            self._columns(name, self.rr.Transform3D.columns(translation=poses[:, :3, 3], quaternion=xyzw))
        else:
            self._static(name, self.rr.Transform3D(translation=poses[0, :3, 3], quaternion=xyzw[0]))

    def _trace(self, name: str, trace: GripperPath) -> None:
        self._static(name, self.rr.LineStrips3D([trace.points], colors=[trace.colour], radii=[PATH_RADIUS_M]))
        self._static(f"{name}/now", self.rr.TransformAxes3D(GRIPPER_AXES_LENGTH_M))
        self._poses(f"{name}/now", trace.poses)

    def _view(self, name: str, view: CameraView) -> None:
        camera, rr, lens_camera = view.camera, self.rr, DepthCamera.from_recording(view.camera)
        self._poses(name, camera.T_world_camera[None])
        can_place = lens_camera.lens.is_identity or not (view.index >= 0).any() or _can_undistort()
        if can_place:  # rerun supports only the pinhole model
            pinhole = rr.Pinhole(
                image_from_camera=camera.K,
                resolution=[camera.width, camera.height],
                camera_xyz=rr.ViewCoordinates.RDF,
                image_plane_distance=IMAGE_PLANE_DISTANCE_M,
            )
            self._static(name, pinhole)
        scale = float(camera.depth_scale or 1)
        for frame in range(len(self.film)):
            depth_image = view.depth_image(frame)
            if depth_image is not None:
                if can_place and not lens_camera.lens.is_identity:
                    depth_image = encode_depth(
                        reproject(decode_depth(depth_image, scale), lens_camera, lens_camera.without_distortion()),
                        scale,
                    )
                self.stream.set_time(TIMELINE, duration=self.film.seconds(frame))
                self.stream.log(
                    self._path(WORLD_ENTITY, f"{name}/depth"), rr.DepthImage(depth_image, meter=1.0 / scale)
                )


def _can_undistort() -> bool:
    """Whether distortion can be removed; otherwise images of a distorted lens are shown as they are, without a pose."""
    try:
        import_open3d()
    except MissingDependency:
        return False
    return True


def _layout(film: Film) -> Any:
    """Lay out the scene, depth images beside it, and below one plot for each quantity.

    Cloths that other viewers show as outlines, and the points of depth images, are hidden at first, because they would
    cover the rest.
    """
    import rerun.blueprint as rrb

    low, high = film.bounds
    target = (low + high) / 2
    position = target + EYE_DISTANCE_FACTOR * (fit_camera(film, RERUN_VIEW_SIZE_PX).T_world_camera[:3, 3] - target)
    depth_cameras = [name for name, view in film.views.items() if (view.index >= 0).any()]
    hidden = [
        *(name for name, sheet in film.sheets.items() if sheet.outline),
        *(f"{name}/depth" for name in depth_cameras),
    ]
    layout: Any = rrb.Spatial3DView(
        origin=f"/{WORLD_ENTITY}",
        name=film.title,
        eye_controls=rrb.EyeControls3D(position=position, look_target=target, eye_up=(0.0, 0.0, 1.0)),
        overrides={f"/{WORLD_ENTITY}/{name}": rrb.EntityBehavior(visible=False) for name in hidden},
    )
    if depth_cameras:
        images = (rrb.Spatial2DView(origin=f"/{WORLD_ENTITY}/{name}", name=name) for name in depth_cameras)
        layout = rrb.Horizontal(layout, rrb.Vertical(*images), column_shares=[3, 1])
    if film.curves:
        quantities = dict.fromkeys(name.split("/")[0] for name in film.curves)
        plots = (rrb.TimeSeriesView(origin=f"/{CURVES_ENTITY}/{name}", name=name) for name in quantities)
        layout = rrb.Vertical(layout, rrb.Horizontal(*plots), row_shares=[3, 1])
    return rrb.Blueprint(layout, collapse_panels=True)


def _rerun() -> Any:
    try:
        import rerun
    except ImportError as error:
        raise MissingDependency(
            "writing a file for rerun needs rerun-sdk", got=str(error), remedy='pip install "torchcloth[viz]"'
        ) from error
    return rerun
