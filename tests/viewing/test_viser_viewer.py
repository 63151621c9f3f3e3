"""Viser server: it answers a browser, and what it sends follows the frames."""

import socket
import struct
import sys
import threading
import time
import urllib.request
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
import viser
import websockets.sync.client
import zstandard

from torchcloth.errors import MissingDependency
from torchcloth.viewing import Viewer, add_cloth, write_viser

FIRST_PORT = 18080  # the search for a free port begins here


@pytest.fixture
def full_film(film):
    """Return a film with a measured cloth and the outline of its truth."""
    cloth = film.sheets["cloth"]
    return add_cloth(
        replace(film, sheets={"truth": cloth}, notes=("one thing is missing",)), cloth.vertices, cloth.faces
    )


@pytest.fixture
def viewer(full_film):
    viewer = Viewer(full_film, FIRST_PORT)
    yield viewer
    viewer.stop()


def handle(viewer, name):
    result = viewer.server.scene.get_handle_by_name(name)
    assert result is not None, name
    return result


def test_the_server_answers_a_browser(viewer):
    with urllib.request.urlopen(f"http://127.0.0.1:{viewer.port}", timeout=10) as answer:
        assert answer.status == 200
        assert b"<html" in answer.read(1000)


def test_the_server_listens_to_this_machine_only(viewer):
    if not Path("/proc/net/tcp").exists():
        pytest.skip("needs Linux's table of sockets")
    sockets = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    listening = {local.split(":")[0] for _, local, _, state, *_ in sockets if local.endswith(f":{viewer.port:04X}")}
    assert listening == {f"{int.from_bytes(socket.inet_aton('127.0.0.1'), sys.byteorder):08X}"}


def test_a_port_that_is_taken_is_no_obstacle(viewer, film):
    other = Viewer(film, viewer.port)
    try:
        assert other.port != viewer.port
    finally:
        other.stop()


def test_everything_follows_the_frame(viewer, full_film):
    for frame in (4, 1):
        viewer.show(frame)
        np.testing.assert_array_equal(handle(viewer, "/points").points, full_film.clouds["points"].frames[frame])
        np.testing.assert_array_equal(handle(viewer, "/truth").vertices, full_film.sheets["truth"].vertices[frame])
        np.testing.assert_allclose(handle(viewer, "/arms/one/ball").position, [0, 0, 0.2 + 0.02 * frame])
        assert viewer.slider.value == frame
        assert f"{full_film.seconds(frame):.3f} s** from the first frame" in viewer._status.content
        assert "mean distance 1.00 mm" in viewer._status.content


def test_bands_of_colour_make_up_the_cloth(viewer, full_film):
    """Every triangle is in one band; 1 mm of 2 mm is in the middle."""
    viewer.show(2)
    bands = [handle(viewer, f"/cloth/{i}") for i in range(13)]
    counts = [len(band.faces) for band in bands]
    assert sum(counts) == len(full_film.sheets["cloth"].faces)
    assert set(np.flatnonzero(counts)) <= {5, 6, 12}
    np.testing.assert_array_equal(bands[0].vertices, full_film.sheets["cloth"].vertices[2])


def test_the_slider_moves_the_scene(viewer, full_film):
    viewer.slider.value = 3
    assert viewer.frame == 3
    np.testing.assert_array_equal(handle(viewer, "/points").points, full_film.clouds["points"].frames[3])


def test_a_browser_receives_what_is_shown(viewer, full_film):
    """The positions of a frame's points come over the wire as they are."""
    address, version = f"ws://127.0.0.1:{viewer.port}", f"viser-v{viser.__version__}"
    wanted = full_film.clouds["points"].frames[5].tobytes()
    with websockets.sync.client.connect(address, subprotocols=[version], max_size=None) as browser:
        viewer.show(5)
        deadline = time.monotonic() + 10
        while wanted not in browser.recv(timeout=10, decode=False):
            assert time.monotonic() < deadline


def test_messages_come_from_the_servers_thread(viewer, monkeypatch):
    """From another one viser fails now and then: "deque mutated during iteration"."""
    threads = set()
    show = viewer.scene.show
    monkeypatch.setattr(viewer.scene, "show", lambda frame: (threads.add(threading.get_ident()), show(frame)))
    loop = viewer.server.get_event_loop()
    viewer.show(1)
    viewer.slider.value = 2
    where = []
    loop.call_soon_threadsafe(lambda: where.append(threading.get_ident()))
    viewer.show(3)
    assert threads == set(where)


def test_groups_are_switched(viewer):
    assert viewer.scene.groups == ["truth", "cloth", "points", "arms", "colliders", "grippers"]
    for group in viewer.scene.groups:
        viewer.scene.switch(group, False)
        assert not handle(viewer, f"/{group}").visible
        assert all(handle(viewer, f"/{other}").visible for other in viewer.scene.groups if other != group)
        viewer.scene.switch(group, True)


def test_it_plays_in_real_time_and_stops(viewer):
    """Six frames of 0.1 s: after 0.35 s it is at the fourth, give or take a busy machine."""
    thread = threading.Thread(target=viewer.run)
    began = time.monotonic()
    thread.start()
    while viewer.frame < 3 and time.monotonic() - began < 10:
        time.sleep(0.005)
    assert 0.25 < time.monotonic() - began < 5
    viewer.playing.value = False
    time.sleep(0.2)
    frame_before = viewer.frame
    time.sleep(0.3)
    assert viewer.frame == frame_before
    viewer.stop()
    thread.join(5)
    assert not thread.is_alive()


def unpacked(path):
    """(content, binary buffers) of a .viser file, as viser's client reads it."""
    data = zstandard.ZstdDecompressor().decompress(path.read_bytes()[8:], max_output_size=1 << 28)
    (length,) = struct.unpack("<Q", data[:8])
    return msgspec.msgpack.decode(data[8 : 8 + length], strict=False), data


def test_a_file_plays_all_frames(full_film, tmp_path):
    content, data = unpacked(write_viser(full_film, tmp_path / "a.viser"))
    assert content["durationSeconds"] == pytest.approx(0.5 + 0.5)
    moments = {round(moment, 6) for moment, _ in content["messages"]}
    assert sorted(moments) == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4, 0.5])
    for points in full_film.clouds["points"].frames:
        assert points.tobytes() in data
    assert [p.name for p in tmp_path.iterdir()] == ["a.viser"]


def test_a_page_holds_all_it_needs(full_film, tmp_path):
    text = write_viser(full_film, tmp_path / "a.html").read_text()
    assert text.lstrip().lower().startswith("<!doctype html>")
    assert len(text) > 100_000  # the player is in it


def test_a_single_frame_can_be_looked_at(film):
    viewer = Viewer(film.select_frames(np.array([0])), FIRST_PORT)
    try:
        assert not viewer.playing.value
        viewer.show(0)
    finally:
        viewer.stop()


def test_without_viser(film, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    for call in (lambda: Viewer(film), lambda: write_viser(film, tmp_path / "a.html")):
        with pytest.raises(MissingDependency, match=r'pip install "torchcloth\[viz\]"'):
            call()
    assert list(tmp_path.iterdir()) == []
