"""Show a film in a browser, from a server with a time slider or from a file that plays by itself."""

from __future__ import annotations

import asyncio
import io
import threading
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np

from .._utils.files import write_atomically
from .colours import get_colour_map, map_colours
from .film import DISTANCE_CURVE, CameraView, Film
from .geometry import Array
from .projection import fit_camera
from .viser_scene import ViserScene, import_viser

SERVER_HOST = "127.0.0.1"  # this machine only; use `ssh -L` to reach it from another
SPEED_RANGE = (0.1, 2.0)  # times real time
MAX_SENT_RATE_HZ = 60.0  # of frames
SERVER_TIMEOUT_S = 60.0  # for one frame; only a server that is stopped meanwhile takes so long
END_PAUSE_S = 0.5  # before the film starts again
BROWSER_VIEW_SIZE_PX = (480, 720)  # part of a browser's window that the panel leaves free
DEPTH_IMAGE_WIDTH_PX = 320
DEPTH_COLOUR_QUANTILE = 0.98  # of the depths, has the last colour
DEPTH_COLOUR_MAP = "viridis"


class Viewer:
    """Server that shows a film, with a time slider, play, speed, and groups to show or hide.

    Args:
        film: what to show.
        port: of the server; the next free one is used if it is taken.

    Attributes:
        port: on which the server listens.

    Raises:
        MissingDependency: viser is not installed.
    """

    def __init__(self, film: Film, port: int = 8080) -> None:
        self.film, self.frame = film, 0
        self.server = _server(film, port)
        self.port: int = self.server.get_port()
        self._closing = threading.Event()
        self._run_on_server(self._build)

    def show(self, frame: int) -> None:
        """Show a frame; the slider follows."""
        self._run_on_server(lambda: self._show(frame))

    def _build(self) -> None:
        _set_camera(self.server, self.film)
        self.scene = ViserScene(self.film, self.server)
        self._add_play_controls()
        self._add_group_switches()
        self._add_readings()
        self._show(0)

    def _show(self, frame: int) -> None:
        self.frame = frame
        with self.server.atomic():
            self.scene.show(frame)
            self._status.content = _status_text(self.film, frame)
            for view, image in self._images:
                pixels = _depth_picture(view, frame)
                image.visible = pixels is not None
                if pixels is not None:
                    image.image = pixels
            self.slider.value = frame

    def _run_on_server(self, action: Callable[[], None]) -> None:
        """Run an action in the server's own thread.

        From another thread viser 1.1 sometimes fails with "deque mutated during iteration": sending a message wakes
        the senders of all clients, which only their own thread may do.
        """
        loop = self.server.get_event_loop()

        async def run_action() -> None:
            action()

        if _running_loop() is loop:
            action()
        elif not self._closing.is_set():
            asyncio.run_coroutine_threadsafe(run_action(), loop).result(SERVER_TIMEOUT_S)

    def run(self) -> None:
        """Play until ``stop`` is called or the process is interrupted."""
        next_time = time.monotonic() + self._seconds_to_next_frame()
        while not self._closing.wait(max(0.0, next_time - time.monotonic())):
            if self.playing.value:
                self.show((self.frame + 1) % len(self.film))
            next_time = max(
                next_time + self._seconds_to_next_frame(), time.monotonic()
            )  # a slow machine does not catch up

    def stop(self) -> None:
        """End ``run`` and stop the server."""
        self._closing.set()
        _stop(self.server)

    def _seconds_to_next_frame(self) -> float:
        """Return the time until the next frame [s]."""
        times = self.film.times
        step = END_PAUSE_S if self.frame + 1 >= len(times) else float(times[self.frame + 1] - times[self.frame])
        return max(step / self.speed.value, 1 / MAX_SENT_RATE_HZ)

    def _add_play_controls(self) -> None:
        gui, last = self.server.gui, max(1, len(self.film) - 1)
        self._status = gui.add_markdown("")
        self.slider = gui.add_slider("frame", min=0, max=last, step=1, initial_value=0, disabled=len(self.film) < 2)
        self.playing = gui.add_checkbox("play", initial_value=len(self.film) > 1)
        self.speed = gui.add_slider("speed", min=SPEED_RANGE[0], max=SPEED_RANGE[1], step=0.1, initial_value=1.0)

        @self.slider.on_update
        def _(_: Any) -> None:
            if self.slider.value != self.frame:
                self.show(int(self.slider.value))

    def _add_group_switches(self) -> None:
        gui = self.server.gui
        with gui.add_folder("show"):
            for group in self.scene.groups:
                bounds = gui.add_checkbox(group, initial_value=True)
                bounds.on_update(lambda event, group=group: self._switch(group, event.target.value))

    def _switch(self, group: str, visible: bool) -> None:
        self._run_on_server(lambda: self.scene.switch(group, visible))

    def _add_readings(self) -> None:
        """Add colour bar, curves, depth images and notes to the panel."""
        gui, film = self.server.gui, self.film
        if film.has_values:
            label = f"{film.legend}: 0 to {film.colour_limit:g} {film.unit}; grey: {film.grey_label}"
            gui.add_image(_colour_bar(), label=label)
        for name, curve in film.curves.items():
            label = {"label": f"{name} [{curve.unit}]", "stroke": "#bd0026", "width": 1.5}
            data = (curve.t - film.times[0], np.asarray(curve.values, float))
            axes = ({"label": "seconds from the first frame"}, label)
            gui.add_uplot(data, axes, scales={"x": {"time": False}}, height=140)
        self._images = [
            (view, gui.add_image(np.zeros((8, 8, 3), np.uint8), label=f"depth of {name}"))
            for name, view in film.views.items()
            if (view.index >= 0).any()
        ]
        for note in film.notes:
            gui.add_markdown(f"*{note}*")


def write_viser(film: Film, path: str | Path) -> Path:
    """Write a film that plays by itself, without controls.

    Args:
        film: what to show.
        path: ``.html``: a self-contained page for any browser; ``.viser``: the scene alone, for viser's own client.
            The file is written atomically.

    Returns:
        ``path``.

    Raises:
        MissingDependency: viser is not installed.
    """
    path = Path(path)
    server = _server(film, 0)
    try:
        scene = ViserScene(film, server)
        _set_camera(server, film)
        recorder = server.get_scene_serializer()
        for frame, step in enumerate([*np.diff(film.times), END_PAUSE_S]):
            scene.show(frame)
            recorder.insert_sleep(float(step))
        page = path.suffix.lower() == ".html"
        with write_atomically(path) as file:
            file.write_bytes(recorder.as_html().encode() if page else recorder.serialize())
    finally:
        _stop(server)
    return path


def _running_loop() -> asyncio.AbstractEventLoop | None:
    try:
        return asyncio.get_running_loop()
    except RuntimeError:
        return None


def _server(film: Film, port: int) -> Any:
    """Start a server that does not print between the lines of the command."""
    with redirect_stdout(io.StringIO()):
        return import_viser().ViserServer(host=SERVER_HOST, port=port, label=film.title, verbose=False)


def _stop(server: Any) -> None:
    with redirect_stdout(io.StringIO()):
        server.stop()


def _set_camera(server: Any, film: Film) -> None:
    """Set the initial camera to that of pictures."""
    camera = fit_camera(film, BROWSER_VIEW_SIZE_PX)
    low, high = film.bounds
    server.initial_camera.position = tuple(camera.T_world_camera[:3, 3])
    server.initial_camera.look_at = tuple((low + high) / 2)
    server.initial_camera.up = (0.0, 0.0, 1.0)
    server.initial_camera.fov = float(2 * np.arctan2(camera.height / 2, camera.K[1, 1]))


def _status_text(film: Film, frame: int) -> str:
    text = f"**{film.seconds(frame):.3f} s** from the first frame"
    if DISTANCE_CURVE in film.curves:
        curve = film.curves[DISTANCE_CURVE]
        now = curve.values[int(np.abs(curve.t - film.times[frame]).argmin())]
        text += f", mean distance {now:.2f} {curve.unit}" if np.isfinite(now) else ", no points"
    return text


def _colour_bar() -> Array:
    """Return a colour bar [12, 256, 3], from 0 on the left to the colour limit on the right."""
    return np.tile(map_colours(np.linspace(0, 1, 256), 1.0), (12, 1, 1))


def _depth_picture(view: CameraView, frame: int) -> Array | None:
    """Return a small picture of a depth image, black where the depth is invalid; None if there is no image."""
    depth_image = view.depth_image(frame)
    if depth_image is None:
        return None
    step = max(1, round(depth_image.shape[1] / DEPTH_IMAGE_WIDTH_PX))
    small = depth_image[::step, ::step].astype(float)
    seen = small[small > 0]
    near, far = (seen.min(), np.quantile(seen, DEPTH_COLOUR_QUANTILE)) if len(seen) else (0.0, 1.0)
    share = np.clip((small - near) / max(far - near, 1.0), 0, 1)
    return np.where(small[..., None] > 0, get_colour_map(DEPTH_COLOUR_MAP)(share, bytes=True)[..., :3], 0).astype(
        np.uint8
    )
