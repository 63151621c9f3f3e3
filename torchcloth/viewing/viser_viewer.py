"""A film in a browser: a server with a time slider, or a file that plays by itself."""

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
from .colours import colour_map, colours
from .film import DISTANCE, Film, View
from .geometry import Array
from .projection import camera_for
from .viser_scene import ViserScene, viser

HOST = "127.0.0.1"  # only this machine; `ssh -L` brings it elsewhere
SPEEDS = (0.1, 2.0)  # times real time
FASTEST = 60.0  # frames a second that are sent
LONGEST = 60.0  # s, for one frame; only a server that was stopped meanwhile takes so long
REST = 0.5  # s, before the film starts anew
WINDOW = (480, 720)  # pixels, of the part of a browser's window that the panel leaves free
DEPTH_SIZE, DEPTH_FAR = 320, 0.98  # pixels; quantile of the depths that has the last colour
DEPTH_MAP = "viridis"


class Viewer:
    """A film on a server of its own, with slider, play, speed, and groups to switch.

    Args:
        film: what to show.
        port: of the server; when it is taken, the next free one.

    Attributes:
        port: where the server listens.

    Raises:
        MissingDependency: viser is not installed.
    """

    def __init__(self, film: Film, port: int = 8080) -> None:
        self.film, self.frame = film, 0
        self.server = _server(film, port)
        self.port: int = self.server.get_port()
        self._closing = threading.Event()
        self._inside(self._build)

    def show(self, frame: int) -> None:
        """Show a frame; the slider follows."""
        self._inside(lambda: self._show(frame))

    def _build(self) -> None:
        _aim(self.server, self.film)
        self.scene = ViserScene(self.film, self.server)
        self._play_controls()
        self._layers()
        self._readings()
        self._show(0)

    def _show(self, frame: int) -> None:
        self.frame = frame
        with self.server.atomic():
            self.scene.show(frame)
            self._clock.content = _words(self.film, frame)
            for view, image in self._images:
                pixels = _depth_picture(view, frame)
                image.visible = pixels is not None
                if pixels is not None:
                    image.image = pixels
            self.slider.value = frame

    def _inside(self, act: Callable[[], None]) -> None:
        """Do something in the server's own thread.

        Elsewhere viser 1.1 now and then fails with "deque mutated during iteration": whoever sends a message wakes the
        senders of all clients, which only their own thread may do.
        """
        loop = self.server.get_event_loop()

        async def acted() -> None:
            act()

        if _running_loop() is loop:
            act()
        elif not self._closing.is_set():
            asyncio.run_coroutine_threadsafe(acted(), loop).result(LONGEST)

    def run(self) -> None:
        """Play, until ``stop`` is called or the process is interrupted."""
        due = time.monotonic() + self._pause()
        while not self._closing.wait(max(0.0, due - time.monotonic())):
            if self.playing.value:
                self.show((self.frame + 1) % len(self.film))
            due = max(due + self._pause(), time.monotonic())  # where the machine is slower, frames are not made up for

    def stop(self) -> None:
        """End ``run``, and the server."""
        self._closing.set()
        _stop(self.server)

    def _pause(self) -> float:
        """Seconds until the next frame."""
        times = self.film.times
        step = REST if self.frame + 1 >= len(times) else float(times[self.frame + 1] - times[self.frame])
        return max(step / self.speed.value, 1 / FASTEST)

    def _play_controls(self) -> None:
        gui, last = self.server.gui, max(1, len(self.film) - 1)
        self._clock = gui.add_markdown("")
        self.slider = gui.add_slider("frame", min=0, max=last, step=1, initial_value=0, disabled=len(self.film) < 2)
        self.playing = gui.add_checkbox("play", initial_value=len(self.film) > 1)
        self.speed = gui.add_slider("speed", min=SPEEDS[0], max=SPEEDS[1], step=0.1, initial_value=1.0)

        @self.slider.on_update
        def _(_: Any) -> None:
            if self.slider.value != self.frame:
                self.show(int(self.slider.value))

    def _layers(self) -> None:
        gui = self.server.gui
        with gui.add_folder("show"):
            for group in self.scene.groups:
                box = gui.add_checkbox(group, initial_value=True)
                box.on_update(lambda event, group=group: self._switch(group, event.target.value))

    def _switch(self, group: str, visible: bool) -> None:
        self._inside(lambda: self.scene.switch(group, visible))

    def _readings(self) -> None:
        """Colour bar, curves, depth images, notes."""
        gui, film = self.server.gui, self.film
        if film.measured:
            gui.add_image(_colour_bar(), label=f"{film.legend}: 0 to {film.worst:g} {film.unit}; grey: {film.grey}")
        for name, curve in film.curves.items():
            series = ({"label": "s"}, {"label": f"{name} [{curve.unit}]", "stroke": "#bd0026", "width": 1.5})
            gui.add_uplot((curve.t, np.asarray(curve.values, float)), series, scales={"x": {"time": False}}, height=140)
        self._images = [
            (view, gui.add_image(np.zeros((8, 8, 3), np.uint8), label=f"depth of {name}"))
            for name, view in film.views.items()
            if (view.index >= 0).any()
        ]
        for note in film.notes:
            gui.add_markdown(f"*{note}*")


def write_viser(film: Film, path: str | Path) -> Path:
    """Write a film that plays by itself, without the controls.

    Args:
        film: what to show.
        path: ``.html``: one page with all in it, for any browser; ``.viser``: the scene alone, for viser's own client.
            The file is there whole or not at all.

    Returns:
        ``path``.

    Raises:
        MissingDependency: viser is not installed.
    """
    path = Path(path)
    server = _server(film, 0)
    try:
        scene = ViserScene(film, server)
        _aim(server, film)
        recorder = server.get_scene_serializer()
        for frame, step in enumerate([*np.diff(film.times), REST]):
            scene.show(frame)
            recorder.insert_sleep(float(step))
        page = path.suffix.lower() == ".html"
        with write_atomically(path) as part:
            part.write_bytes(recorder.as_html().encode() if page else recorder.serialize())
    finally:
        _stop(server)
    return path


def _running_loop() -> asyncio.AbstractEventLoop | None:
    try:
        return asyncio.get_running_loop()
    except RuntimeError:
        return None


def _server(film: Film, port: int) -> Any:
    """A server that does not print: its words would be between those of the command."""
    with redirect_stdout(io.StringIO()):
        return viser().ViserServer(host=HOST, port=port, label=film.title, verbose=False)


def _stop(server: Any) -> None:
    with redirect_stdout(io.StringIO()):
        server.stop()


def _aim(server: Any, film: Film) -> None:
    """Put the eye where pictures are taken from."""
    camera = camera_for(film, WINDOW)
    low, high = film.box
    server.initial_camera.position = tuple(camera.T_world_camera[:3, 3])
    server.initial_camera.look_at = tuple((low + high) / 2)
    server.initial_camera.up = (0.0, 0.0, 1.0)
    server.initial_camera.fov = float(2 * np.arctan2(camera.height / 2, camera.K[1, 1]))


def _words(film: Film, frame: int) -> str:
    words = f"**{film.times[frame]:.3f} s**"
    if DISTANCE in film.curves:
        curve = film.curves[DISTANCE]
        now = curve.values[int(np.abs(curve.t - film.times[frame]).argmin())]
        words += f", mean distance {now:.2f} {curve.unit}" if np.isfinite(now) else ", no points"
    return words


def _colour_bar() -> Array:
    """[12, 256, 3] from 0 on the left to the worst on the right."""
    return np.tile(colours(np.linspace(0, 1, 256), 1.0), (12, 1, 1))


def _depth_picture(view: View, frame: int) -> Array | None:
    """A small picture of a depth image, black where the sensor saw nothing."""
    raw = view.raw(frame)
    if raw is None:
        return None
    step = max(1, round(raw.shape[1] / DEPTH_SIZE))
    small = raw[::step, ::step].astype(float)
    seen = small[small > 0]
    near, far = (seen.min(), np.quantile(seen, DEPTH_FAR)) if len(seen) else (0.0, 1.0)
    share = np.clip((small - near) / max(far - near, 1.0), 0, 1)
    return np.where(small[..., None] > 0, colour_map(DEPTH_MAP)(share, bytes=True)[..., :3], 0).astype(np.uint8)
