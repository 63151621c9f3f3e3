"""The shapes of a film in a viser scene."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np

from ..errors import MissingDependency
from .colours import UNKNOWN_COLOUR, map_colours
from .film import (
    GRID_CELL_M,
    GRIPPER_AXES_LENGTH_M,
    CameraView,
    ClothSurface,
    Cloud,
    Colour,
    Film,
    GripperPath,
    GroundPlane,
    RigidBody,
    ground_planes,
)
from .geometry import Array, to_quaternions

POINT_SIZE_M = 0.004
LINE_WIDTH_PX = 2.0
AXES_RADIUS_M = 0.0015  # of a gripper's axes
FRUSTUM_SIZE_M = 0.08  # of a camera
COLOUR_BANDS = 12  # on a sheet with values

Part = TypeVar("Part")


def import_viser() -> Any:
    """Import viser, late because this takes a second.

    Raises:
        MissingDependency: viser is not installed.
    """
    try:
        import viser
    except ImportError as error:
        raise MissingDependency(
            "viewing in a browser needs viser", got=str(error), remedy='pip install "torchcloth[viz]"'
        ) from error
    return viser


class ViserScene:
    """Shapes of a film on a server, shown or hidden by group.

    Attributes:
        groups: names of the groups, "cloth", "points", "arms", ...
    """

    def __init__(self, film: Film, server: Any) -> None:
        self.film = film
        self.scene: Any = server.scene
        self._updates: list[Callable[[int], None]] = []
        self._groups: dict[str, Any] = {}
        self.scene.set_up_direction("+z")
        self._add_parts(film.sheets, self._sheet)
        self._add_parts(film.clouds, self._cloud)
        self._add_parts(film.solids, self._solid)
        self._add_parts(film.planes, self._plane)
        self._add_parts(film.traces, self._trace)
        self._add_parts(film.views, self._view)
        if not film.planes:
            self._floor(ground_planes(film)[0])
        self.show(0)

    @property
    def groups(self) -> list[str]:
        """Names of the groups that can be shown or hidden."""
        return list(self._groups)

    def switch(self, group: str, visible: bool) -> None:
        """Show or hide a group."""
        self._groups[group].visible = visible

    def show(self, frame: int) -> None:
        """Move all shapes to a frame."""
        for update in self._updates:
            update(frame)

    def _add_parts(self, parts: Mapping[str, Part], add: Callable[[str, Part], Any]) -> None:
        for name, part in parts.items():
            group = name.split("/")[0]
            if group not in self._groups:
                self._groups[group] = self.scene.add_frame(f"/{group}", show_axes=False)
            node = add(f"/{name}", part)
            if node is not None and name == group:  # the shape has replaced the group's frame
                self._groups[group] = node

    def _sheet(self, name: str, sheet: ClothSurface) -> Any:
        """Add a sheet as bands of colour: a viser mesh has one colour, and GLB models load too slowly to animate."""
        x, faces = sheet.vertices, sheet.faces
        if sheet.values is None:
            mesh = self._mesh(name, x[0], faces, sheet.colour, flat=False, side="double", wireframe=sheet.outline)
            self._updates.append(lambda frame: setattr(mesh, "vertices", x[frame]))
            return mesh
        steps = self.film.colour_limit * (np.arange(COLOUR_BANDS) + 0.5) / COLOUR_BANDS
        shades = [*map_colours(steps, self.film.colour_limit).tolist(), UNKNOWN_COLOUR]
        values = sheet.values[:, faces].mean(axis=-1)  # [T, F], NaN if a corner is unknown
        known = np.clip(np.nan_to_num(values) / self.film.colour_limit * COLOUR_BANDS, 0, COLOUR_BANDS - 1).astype(int)
        band = np.where(np.isnan(values), COLOUR_BANDS, known)
        for number, shade in enumerate(shades):
            mesh = self._mesh(f"{name}/{number}", x[0], faces, tuple(shade), flat=False, side="double")
            self._updates.append(
                lambda frame, mesh=mesh, number=number: _move(mesh, x[frame], faces[band[frame] == number])
            )
        return None

    def _cloud(self, name: str, cloud: Cloud) -> Any:
        points = self.scene.add_point_cloud(
            name, cloud.frames[0], cloud.colour, point_size=POINT_SIZE_M, point_shape="circle", precision="float32"
        )
        self._updates.append(lambda frame: setattr(points, "points", cloud.frames[frame]))
        return points

    def _solid(self, name: str, solid: RigidBody) -> None:
        mesh = self._mesh(name, solid.vertices, solid.faces, solid.colour)
        self._follow(mesh, solid.poses)

    def _plane(self, name: str, plane: GroundPlane) -> None:
        self._mesh(name, plane.corners, plane.FACES, plane.colour, side="double")

    def _floor(self, plane: GroundPlane) -> None:
        width = float(np.ptp(plane.corners[:, 0]))
        move = tuple(plane.corners.mean(0))
        self.scene.add_grid(
            "/floor", width=width, height=width, cell_size=GRID_CELL_M, section_size=5 * GRID_CELL_M, position=move
        )

    def _mesh(self, name: str, x: Array, faces: Array, colour: Colour, flat: bool = True, **options: Any) -> Any:
        return self.scene.add_mesh_simple(name, x.astype(np.float32), faces, color=colour, flat_shading=flat, **options)

    def _trace(self, name: str, trace: GripperPath) -> None:
        segments = np.stack([trace.points[:-1], trace.points[1:]], axis=1).astype(np.float32)
        self.scene.add_line_segments(name, segments, trace.colour, thickness=LINE_WIDTH_PX, thickness_units="screen")
        axes = self.scene.add_frame(f"{name}/now", axes_length=GRIPPER_AXES_LENGTH_M, axes_radius=AXES_RADIUS_M)
        self._follow(axes, trace.poses)

    def _view(self, name: str, view: CameraView) -> None:
        camera = view.camera
        fov = 2 * np.arctan2(camera.height / 2, camera.K[1, 1])
        frustum = self.scene.add_camera_frustum(
            name,
            float(fov),
            camera.width / camera.height,
            scale=FRUSTUM_SIZE_M,
            thickness=LINE_WIDTH_PX,
            thickness_units="screen",
        )
        self._follow(frustum, camera.T_world_camera[None])

    def _follow(self, handle: Any, poses: Array) -> None:
        wxyz, places = to_quaternions(poses[:, :3, :3]), poses[:, :3, 3]

        def move(frame: int) -> None:
            handle.wxyz, handle.position = wxyz[frame], places[frame]

        move(0)
        if len(poses) > 1:
            self._updates.append(move)


def _move(mesh: Any, x: Array, faces: Array) -> None:
    mesh.vertices, mesh.faces = x, faces.astype(np.uint32)
