"""A film as a file for rerun's viewer (``rerun FILE.rrd``)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .._utils.files import write_atomically
from ..errors import MissingDependency
from ..meshes.mesh import vertex_normals
from ..observe import DepthCamera, decode, encode, reproject
from ..observe.render import open3d_or_refuse
from .colours import colours
from .film import Film, Solid, Trace, View
from .geometry import Array, quaternions
from .projection import camera_for

TIME = "time"  # the timeline, s on the motion clock
WORLD, CURVES = "world", "curves"
DOT = 0.0025  # m, radius of a point
LINE = 0.0015  # m, radius of a gripper's path
AXES = 0.05  # m, length of a gripper's axes
IMAGE_PLANE = 0.15  # m, of a camera's frustum
WINDOW, NEARER = (800, 600), 0.5  # pixels; its lens is wider than that of pictures, so the eye comes nearer


def write_rrd(film: Film, path: str | Path) -> Path:
    """Write a film for rerun's viewer: shapes in the world, curves, depth images, on the timeline "time".

    Depth images of a distorted lens are written as an ideal lens would have taken them.

    Args:
        film: what to show.
        path: the file; it only ever holds a whole recording.

    Returns:
        ``path``.

    Raises:
        MissingDependency: rerun-sdk is not installed.
    """
    rr = _rerun()
    with write_atomically(Path(path)) as part:
        part.touch()  # where nothing can be written, rerun's own error would not say which file
        stream = rr.RecordingStream("torchcloth")
        stream.save(part, default_blueprint=_layout(film))
        stream.send_recording_name(film.title)
        stream.log(WORLD, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        _Writer(rr, stream, film).write()
        stream.flush()
        stream.disconnect()
    return Path(path)


class _Writer:
    """Sends each kind of part in columns: one message for all frames."""

    def __init__(self, rr: Any, stream: Any, film: Film) -> None:
        self.rr, self.stream, self.film = rr, stream, film

    def write(self) -> None:
        film, rr = self.film, self.rr
        for name in film.sheets:
            self._sheet(name)
        for name, cloud in film.clouds.items():
            self._static(name, rr.Points3D.from_fields(colors=[cloud.colour], radii=[DOT]))
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
            times = rr.TimeColumn(TIME, duration=curve.t[known])
            self.stream.send_columns(self._path(CURVES, name), [times], rr.Scalars.columns(scalars=curve.values[known]))
            self.stream.log(self._path(CURVES, name), rr.SeriesLines(names=f"{name} [{curve.unit}]"), static=True)

    def _path(self, root: str, name: str) -> str:
        return self.rr.new_entity_path([root, *name.split("/")])

    def _static(self, name: str, what: Any) -> None:
        self.stream.log(self._path(WORLD, name), what, static=True)

    def _columns(self, name: str, columns: Any) -> None:
        times = self.rr.TimeColumn(TIME, duration=self.film.times)
        self.stream.send_columns(self._path(WORLD, name), [times], columns)

    def _sheet(self, name: str) -> None:
        sheet, count = self.film.sheets[name], len(self.film)
        x = sheet.vertices
        fields = {"vertex_positions": x.reshape(-1, 3)}
        if sheet.values is None:
            fixed = self.rr.Mesh3D.from_fields(triangle_indices=sheet.faces, albedo_factor=sheet.colour)
            normals = np.stack([vertex_normals(frame, sheet.faces) for frame in x])
            fields["vertex_normals"] = normals.astype(np.float32).reshape(-1, 3)
        else:  # without normals it is not shaded, and its colours are those of the scale
            fixed = self.rr.Mesh3D.from_fields(triangle_indices=sheet.faces)
            fields["vertex_colors"] = colours(sheet.values, self.film.worst).reshape(-1, 3)
        self._static(name, fixed)
        self._columns(name, self.rr.Mesh3D.columns(**fields).partition([x.shape[1]] * count))

    def _mesh(self, name: str, vertices: Array, faces: Array, colour: tuple[int, int, int]) -> None:
        flat = vertices[faces].reshape(-1, 3)  # corners of their own: edges stay sharp
        index = np.arange(len(flat)).reshape(-1, 3)
        normals = vertex_normals(flat, index)
        self._static(
            name,
            self.rr.Mesh3D(vertex_positions=flat, triangle_indices=index, vertex_normals=normals, albedo_factor=colour),
        )

    def _solid(self, name: str, solid: Solid) -> None:
        self._mesh(name, solid.vertices, solid.faces, solid.colour)
        self._poses(name, solid.poses)

    def _poses(self, name: str, poses: Array) -> None:
        """Quaternions are xyzw in rerun."""
        turned = quaternions(poses[:, :3, :3])[:, [1, 2, 3, 0]]
        if len(poses) == len(self.film):
            self._columns(name, self.rr.Transform3D.columns(translation=poses[:, :3, 3], quaternion=turned))
        else:
            self._static(name, self.rr.Transform3D(translation=poses[0, :3, 3], quaternion=turned[0]))

    def _trace(self, name: str, trace: Trace) -> None:
        self._static(name, self.rr.LineStrips3D([trace.points], colors=[trace.colour], radii=[LINE]))
        self._static(f"{name}/now", self.rr.TransformAxes3D(AXES))
        self._poses(f"{name}/now", trace.poses)

    def _view(self, name: str, view: View) -> None:
        camera, rr, taken = view.camera, self.rr, DepthCamera.of(view.camera)
        self._poses(name, camera.T_world_camera[None])
        straight = taken.lens.plain or not (view.index >= 0).any() or _rays_can_be_cast()
        if straight:  # rerun knows no other lens
            pinhole = rr.Pinhole(
                image_from_camera=camera.K,
                resolution=[camera.width, camera.height],
                camera_xyz=rr.ViewCoordinates.RDF,
                image_plane_distance=IMAGE_PLANE,
            )
            self._static(name, pinhole)
        scale = float(camera.depth_scale or 1)
        for frame, time in enumerate(self.film.times):
            raw = view.raw(frame)
            if raw is not None:
                if straight and not taken.lens.plain:
                    raw = encode(reproject(decode(raw, scale), taken, taken.rectified()), scale)
                self.stream.set_time(TIME, duration=float(time))
                self.stream.log(self._path(WORLD, f"{name}/depth"), rr.DepthImage(raw, meter=1.0 / scale))


def _rays_can_be_cast() -> bool:
    """Whether a lens can be taken out; images of a distorted one are else shown as they are, and placed nowhere."""
    try:
        open3d_or_refuse()
    except MissingDependency:
        return False
    return True


def _layout(film: Film) -> Any:
    """The scene from where pictures are taken, depth images beside it, curves below, one plot for each quantity.

    Sheets that others show as nets and the points of depth images would hide the rest: they are off at first.
    """
    import rerun.blueprint as rrb

    low, high = film.box
    target = (low + high) / 2
    position = target + NEARER * (camera_for(film, WINDOW).T_world_camera[:3, 3] - target)
    deep = [name for name, view in film.views.items() if (view.index >= 0).any()]
    hidden = [*(name for name, sheet in film.sheets.items() if sheet.net), *(f"{name}/depth" for name in deep)]
    shown: Any = rrb.Spatial3DView(
        origin=f"/{WORLD}",
        name=film.title,
        eye_controls=rrb.EyeControls3D(position=position, look_target=target, eye_up=(0.0, 0.0, 1.0)),
        overrides={f"/{WORLD}/{name}": rrb.EntityBehavior(visible=False) for name in hidden},
    )
    if deep:
        images = (rrb.Spatial2DView(origin=f"/{WORLD}/{name}", name=name) for name in deep)
        shown = rrb.Horizontal(shown, rrb.Vertical(*images), column_shares=[3, 1])
    if film.curves:
        quantities = dict.fromkeys(name.split("/")[0] for name in film.curves)
        plots = (rrb.TimeSeriesView(origin=f"/{CURVES}/{name}", name=name) for name in quantities)
        shown = rrb.Vertical(shown, rrb.Horizontal(*plots), row_shares=[3, 1])
    return rrb.Blueprint(shown, collapse_panels=True)


def _rerun() -> Any:
    try:
        import rerun
    except ImportError as error:
        raise MissingDependency(
            "writing a file for rerun needs rerun-sdk", got=str(error), remedy='pip install "torchcloth[viz]"'
        ) from error
    return rerun
