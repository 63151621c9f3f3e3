"""A film's shapes in a viser scene; ``show`` moves them to a frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np

from ..errors import MissingDependency
from .colours import UNKNOWN, colours
from .film import CELL, Cloud, Colour, Film, Plane, Sheet, Solid, Trace, View, ground_of
from .geometry import Array, quaternions

DOT = 0.004  # m, size of a point
LINE = 2.0  # pixels
AXES, AXIS = 0.05, 0.0015  # m, length and radius of a gripper's axes
FRUSTUM = 0.08  # m
BANDS = 12  # of colour on a sheet with values

Part = TypeVar("Part")


def viser() -> Any:
    """The package, imported here: it takes a second.

    Raises:
        MissingDependency: it is not installed.
    """
    try:
        import viser
    except ImportError as error:
        raise MissingDependency(
            "viewing in a browser needs viser", got=str(error), remedy='pip install "torchcloth[viz]"'
        ) from error
    return viser


class ViserScene:
    """The shapes of a film on a server, switched on and off by group.

    Attributes:
        groups: names of the groups, "cloth", "points", "arms", ...
    """

    def __init__(self, film: Film, server: Any) -> None:
        self.film = film
        self.scene: Any = server.scene
        self._updates: list[Callable[[int], None]] = []
        self._groups: dict[str, Any] = {}
        self.scene.set_up_direction("+z")
        self._all(film.sheets, self._sheet)
        self._all(film.clouds, self._cloud)
        self._all(film.solids, self._solid)
        self._all(film.planes, self._plane)
        self._all(film.traces, self._trace)
        self._all(film.views, self._view)
        if not film.planes:
            self._floor(ground_of(film)[0])
        self.show(0)

    @property
    def groups(self) -> list[str]:
        """Names of the groups that can be switched."""
        return list(self._groups)

    def switch(self, group: str, visible: bool) -> None:
        """Show or hide a group."""
        self._groups[group].visible = visible

    def show(self, frame: int) -> None:
        """Move everything to a frame."""
        for update in self._updates:
            update(frame)

    def _all(self, parts: Mapping[str, Part], add: Callable[[str, Part], Any]) -> None:
        for name, part in parts.items():
            group = name.split("/")[0]
            if group not in self._groups:
                self._groups[group] = self.scene.add_frame(f"/{group}", show_axes=False)
            made = add(f"/{name}", part)
            if made is not None and name == group:  # it has taken the frame's place
                self._groups[group] = made

    def _sheet(self, name: str, sheet: Sheet) -> Any:
        """Bands of colour: viser's meshes have one colour each, and its GLB are loaded too slowly to be animated."""
        x, faces = sheet.vertices, sheet.faces
        if sheet.values is None:
            mesh = self._mesh(name, x[0], faces, sheet.colour, flat=False, side="double", wireframe=sheet.net)
            self._updates.append(lambda frame: setattr(mesh, "vertices", x[frame]))
            return mesh
        steps = self.film.worst * (np.arange(BANDS) + 0.5) / BANDS
        shades = [*colours(steps, self.film.worst).tolist(), UNKNOWN]
        values = sheet.values[:, faces].mean(axis=-1)  # [T, F], NaN beside what is unknown
        known = np.clip(np.nan_to_num(values) / self.film.worst * BANDS, 0, BANDS - 1).astype(int)
        band = np.where(np.isnan(values), BANDS, known)
        for number, shade in enumerate(shades):
            mesh = self._mesh(f"{name}/{number}", x[0], faces, tuple(shade), flat=False, side="double")
            self._updates.append(
                lambda frame, mesh=mesh, number=number: _move(mesh, x[frame], faces[band[frame] == number])
            )
        return None

    def _cloud(self, name: str, cloud: Cloud) -> Any:
        points = self.scene.add_point_cloud(
            name, cloud.frames[0], cloud.colour, point_size=DOT, point_shape="circle", precision="float32"
        )
        self._updates.append(lambda frame: setattr(points, "points", cloud.frames[frame]))
        return points

    def _solid(self, name: str, solid: Solid) -> None:
        mesh = self._mesh(name, solid.vertices, solid.faces, solid.colour)
        self._follow(mesh, solid.poses)

    def _plane(self, name: str, plane: Plane) -> None:
        self._mesh(name, plane.corners, plane.FACES, plane.colour, side="double")

    def _floor(self, plane: Plane) -> None:
        width = float(np.ptp(plane.corners[:, 0]))
        place = tuple(plane.corners.mean(0))
        self.scene.add_grid("/floor", width=width, height=width, cell_size=CELL, section_size=5 * CELL, position=place)

    def _mesh(self, name: str, x: Array, faces: Array, colour: Colour, flat: bool = True, **options: Any) -> Any:
        return self.scene.add_mesh_simple(name, x.astype(np.float32), faces, color=colour, flat_shading=flat, **options)

    def _trace(self, name: str, trace: Trace) -> None:
        segments = np.stack([trace.points[:-1], trace.points[1:]], axis=1).astype(np.float32)
        self.scene.add_line_segments(name, segments, trace.colour, thickness=LINE, thickness_units="screen")
        axes = self.scene.add_frame(f"{name}/now", axes_length=AXES, axes_radius=AXIS)
        self._follow(axes, trace.poses)

    def _view(self, name: str, view: View) -> None:
        camera = view.camera
        fov = 2 * np.arctan2(camera.height / 2, camera.K[1, 1])
        frustum = self.scene.add_camera_frustum(
            name, float(fov), camera.width / camera.height, scale=FRUSTUM, thickness=LINE, thickness_units="screen"
        )
        self._follow(frustum, camera.T_world_camera[None])

    def _follow(self, handle: Any, poses: Array) -> None:
        turned, places = quaternions(poses[:, :3, :3]), poses[:, :3, 3]

        def place(frame: int) -> None:
            handle.wxyz, handle.position = turned[frame], places[frame]

        place(0)
        if len(poses) > 1:
            self._updates.append(place)


def _move(mesh: Any, x: Array, faces: Array) -> None:
    mesh.vertices, mesh.faces = x, faces.astype(np.uint32)
