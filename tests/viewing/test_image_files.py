"""What is seen on the pictures is where and what the film says."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from torchcloth.errors import InvalidInput
from torchcloth.viewing import ClothSurface, Cloud, Curve, GroundPlane, write_gif, write_png
from torchcloth.viewing.frame_renderer import FrameRenderer
from torchcloth.viewing.image_files import _durations
from torchcloth.viewing.projection import fit_camera, project_polygons

FROM_ABOVE = (0.0, 89.0)  # azimuth, elevation: straight down, nearly
RED, BLUE = (255, 0, 0), (0, 0, 255)


def square(z, colour, half=0.1):
    """One frame of a level square at a height."""
    x = np.array([[[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]]], np.float32)
    return ClothSurface(x, np.array([[0, 1, 2], [0, 2, 3]]), colour=colour)


def only(film, **parts):
    """One frame with nothing but these parts."""
    empty = {kind: {} for kind in ("sheets", "clouds", "solids", "planes", "traces", "curves")}
    return replace(film, times=np.array([0.0]), **{**empty, **parts})


def at(renderer, point, frame=0):
    """The colour of the pixel where a world point is seen, 0 to 1."""
    column, row = renderer.camera.project(np.asarray(point, float))[0].round().astype(int)
    return renderer.pixels(frame)[row, column] / 255


@pytest.mark.parametrize(
    "eye_direction_deg", [(0.0, 20.0), (130.0, 35.0), (0.0, 90.0), (70.0, -90.0), FROM_ABOVE, None]
)
def test_the_camera_sees_everything(film, eye_direction_deg):
    camera = fit_camera(film, (400, 300), eye_direction_deg)
    low, high = film.bounds
    corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T
    pixels, depth = camera.project(corners)
    assert (depth > 0.1).all()
    assert pixels.min() > 0
    assert (pixels.max(0) < [400, 300]).all()
    spread = np.ptp(pixels, axis=0) / [400, 300]
    assert spread.max() > 0.6  # and it is not far away


@pytest.mark.parametrize("end", [90.0, -90.0])
def test_straight_above_and_below_are_where_steep_ones_lead_to(film, end, tmp_path):
    cameras = [fit_camera(film, (400, 300), (30.0, elevation)) for elevation in (end, end * (1 - 1e-5))]
    np.testing.assert_allclose(cameras[0].T_world_camera, cameras[1].T_world_camera, rtol=0, atol=1e-4)
    assert write_png(film, tmp_path / "a.png", eye_direction_deg=(30.0, end)).is_file()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("part", ["gripper", "point"])
def test_what_has_no_size_can_be_looked_at(film, part, tmp_path):
    """A gripper that stands still, or a single point: in the middle, and not a wall of colour."""
    trace = next(iter(film.traces.values()))
    still = replace(trace, points=trace.points[:1].repeat(5, 0), poses=trace.poses[:1])
    clouds = {"points": Cloud((trace.points[:1].astype(np.float32),))}
    one = only(film, **({"traces": {"grippers/one": still}} if part == "gripper" else {"clouds": clouds}))
    camera = fit_camera(one, (400, 300))
    np.testing.assert_allclose(camera.project(trace.points[0])[0], [199.5, 149.5], atol=30)
    assert write_png(one, tmp_path / "a.png").is_file()
    if part == "gripper":
        assert np.ptp(one.bounds, axis=0) == pytest.approx(0.3)


def test_lengths_are_equal_in_all_directions(film):
    """Looking along an axis, what is equally long and equally far is equally long in the picture."""
    camera = fit_camera(film, (500, 300), (0.0, 0.0))
    origin, along, up = camera.project(np.array([[0.0, 0, 0.1], [0, 0.1, 0.1], [0, 0, 0.2]]))[0]
    assert np.linalg.norm(along - origin) == pytest.approx(np.linalg.norm(up - origin), rel=1e-6)
    assert up[1] < origin[1]  # z is up


@pytest.mark.parametrize("size", [0.05, 0.4])
def test_a_table_that_goes_on_behind_the_camera_is_under_the_cloth(film, size):
    """Corners behind the camera fell on the picture upside down."""
    colour, corners = (0, 200, 0), np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    table = GroundPlane(0.6 * corners - [0, 0, 0.3 * size], colour)
    renderer = FrameRenderer(
        only(film, sheets={"cloth": square(0.0, RED, size / 2)}, planes={"table": table}), size=(300, 300)
    )
    beside = at(renderer, [0.6 * size, -0.6 * size, -0.3 * size])
    assert beside[1] > 0.6 > 0.3 > beside[0]


def test_what_is_in_front_is_seen(film):
    near, far = {"a": square(0.1, RED), "b": square(0.0, BLUE)}, {"a": square(-0.1, RED), "b": square(0.0, BLUE)}
    red, blue = (at(FrameRenderer(only(film, sheets=s), (300, 300), FROM_ABOVE), (0, 0, 0)) for s in (near, far))
    assert red[0] > 0.5 > red[2]
    assert blue[2] > 0.5 > blue[0]


def test_points_are_hidden_by_the_cloth_before_them(film):
    def seen(z):
        cloud = {"points": Cloud((np.array([[0.05, 0.02, z]]),), BLUE)}
        return at(
            FrameRenderer(only(film, sheets={"a": square(0.0, RED)}, clouds=cloud), (300, 300), FROM_ABOVE),
            (0.05, 0.02, z),
        )

    assert seen(0.001)[2] > seen(0.001)[0]  # measured on the surface, give or take noise
    assert seen(-0.001)[2] > seen(-0.001)[0]
    assert seen(-0.05)[0] > seen(-0.05)[2]


def test_light_falls_on_both_sides_and_shows_the_slope(film):
    level, steep = square(0.0, (200, 200, 200)), square(0.0, (200, 200, 200))
    steep.vertices[..., 2] = 2.0 * steep.vertices[..., 1]  # turned away from the light
    over = dict(
        zip(
            ("level", "steep"),
            (at(FrameRenderer(only(film, sheets={"a": s}), (300, 300), FROM_ABOVE), (0, 0, 0)) for s in (level, steep)),
            strict=True,
        )
    )
    assert over["level"].mean() > over["steep"].mean() > 0.2
    below = replace(level, faces=level.faces[:, ::-1])
    assert (
        0.3
        < at(FrameRenderer(only(film, sheets={"a": below}), (300, 300), FROM_ABOVE), (0, 0, 0)).mean()
        < over["level"].mean()
    )


def test_values_have_the_colours_of_the_bar(film):
    good, bad = np.zeros((1, 4), np.float32), np.full((1, 4), 9.0, np.float32)
    colours = []
    for values in (good, bad, np.full((1, 4), np.nan, np.float32)):
        sheet = replace(square(0.0, RED), values=values)
        colours.append(
            at(FrameRenderer(only(film, sheets={"a": sheet}, colour_limit=5.0), (300, 300), FROM_ABOVE), (0, 0, 0))
        )
    pale, dark, unknown = colours
    assert pale.min() > 0.6
    assert dark[0] > 0.3
    assert dark[1:].max() < 0.2
    assert np.ptp(unknown) < 0.05  # grey


def test_closed_bodies_hide_their_far_side(film):
    ball = only(film, solids={"ball": replace(film.solids["arms/one/ball"], poses=np.eye(4)[None])})
    drawn = project_polygons(ball, 0, fit_camera(ball, (300, 300)))
    assert 0.3 < len(drawn.corners) / len(film.solids["arms/one/ball"].faces) < 0.6


def test_the_farthest_comes_first(film):
    camera = fit_camera(film, (300, 300))
    one, both = only(film, sheets={"a": square(0.3, RED)}), {"b": square(0.3, RED), "a": square(0.0, BLUE)}
    assert len(project_polygons(one, 0, camera).corners) == 2
    red = project_polygons(only(film, sheets=both), 0, camera).colours[:, 0]
    assert (red[:2] < red[2:]).all()


def test_crowds_of_points_are_thinned_evenly(film):
    line = np.linspace(-0.1, 0.1, 5000)[:, None] * [1.0, 0, 0]
    crowd = only(film, sheets={"a": square(-0.05, RED)}, clouds={"points": Cloud((line,))})
    camera = fit_camera(crowd, (300, 300), FROM_ABOVE)
    drawn = project_polygons(crowd, 0, camera).corners[2:].mean(axis=1)  # the square is farther
    ends = camera.project(line[[0, -1]])[0]
    assert 750 < len(drawn) <= 1500
    np.testing.assert_allclose(np.sort(drawn[:, 1])[[0, -1]], np.sort(ends[:, 1]), atol=0.5)


def test_a_gif_plays_in_real_time(film, tmp_path):
    done = []
    path = write_gif(film, tmp_path / "new" / "a.gif", size=(240, 200), on_frame=lambda *call: done.append(call))
    with Image.open(path) as gif:
        assert (gif.size, gif.n_frames) == ((240, 200), 6)
        lasting = []
        for i in range(6):
            gif.seek(i)
            lasting.append(gif.info["duration"])
        first, last = (np.asarray((gif.seek(i), gif.convert("RGB"))[1]) for i in (0, 5))
    assert sum(lasting) == 600  # the last frame lasts as long as the one before
    assert done[-1] == (6, 6)
    assert (first != last).any(axis=-1).mean() > 0.02
    assert [p.name for p in path.parent.iterdir()] == ["a.gif"]


def test_two_films_play_side_by_side_from_one_eye(film, tmp_path):
    path = write_gif(film, tmp_path / "a.gif", size=(240, 200), left=film)
    with Image.open(path) as gif:
        assert (gif.size, gif.n_frames) == ((480, 200), 6)
        pixels = np.asarray(gif.convert("RGB"))
    np.testing.assert_array_equal(pixels[:, :240], pixels[:, 240:])
    with pytest.raises(InvalidInput, match="at other times"):
        write_gif(film, tmp_path / "b.gif", left=film.select_frames(np.arange(3)))


def test_durations_are_hundredths_whose_sum_is_right():
    times = np.arange(31) / 30  # 33.3 ms
    result = _durations(times)
    assert set(result) == {30, 40}
    assert sum(result[:30]) == 1000
    assert _durations(np.array([3.0])) == [1000]
    uneven = np.arange(501) / 60 * 1.2  # 50 a second of 60: every other one is nearer than a GIF can show
    uneven[1::2] -= 0.004
    assert sum(_durations(uneven)[:500]) == 10000


def test_a_gif_has_at_most_fifty_frames_a_second(film, tmp_path):
    with pytest.raises(InvalidInput, match="rate; got 60"):
        write_gif(film, tmp_path / "a.gif", rate=60.0)
    for size in ((60, 400), (400, 60), (400, 5000)):
        with pytest.raises(InvalidInput, match=rf"got {size[0]}x{size[1]}; expected at least 120 and at most 4096"):
            write_gif(film, tmp_path / "a.gif", size=size)
    assert list(tmp_path.iterdir()) == []


def test_a_png_has_four_moments(film, tmp_path):
    with Image.open(write_png(film, tmp_path / "a.png", size=(200, 160))) as image:
        pixels = np.asarray(image.convert("RGB"))
    assert pixels.shape == (160, 800, 3)
    assert (pixels[:, :200] != pixels[:, 600:]).any()


def test_the_title_is_shown_once_and_the_colour_bar_at_the_end(film, tmp_path):
    sheet = film.sheets["cloth"]
    coloured = replace(film, sheets={"cloth": replace(sheet, values=np.ones(sheet.vertices.shape[:2], np.float32))})
    renderer = FrameRenderer(coloured, (400, 160))
    full_film, scene = renderer.pixels(0), renderer.scene_width
    assert 320 < scene < 400
    with Image.open(write_png(coloured, tmp_path / "a.png", size=(400, 160))) as image:
        pixels = np.asarray(image.convert("RGB"))
    assert pixels.shape == (160, 3 * scene + 400, 3)
    np.testing.assert_array_equal(pixels[:, :scene], full_film[:, :scene])
    last = pixels[:, 3 * scene :]
    np.testing.assert_array_equal(last[:, scene:], full_film[:, scene:])
    assert (renderer.pixels(5)[:30, :scene] != last[:30, :scene]).any()
    np.testing.assert_array_equal(last, renderer.pixels(5, titled=False))


def test_one_frame_is_enough(film, tmp_path):
    still = film.select_frames(np.array([2]))
    with Image.open(write_gif(still, tmp_path / "a.gif", size=(200, 160))) as gif:
        assert gif.n_frames == 1
    with Image.open(write_png(still, tmp_path / "a.png", size=(200, 160))) as image:
        assert image.size == (200, 160)


def test_the_curve_of_distances_is_drawn_below(film):
    curve = {"distance": Curve(film.times, np.linspace(1, 3, 6), "mm")}
    plain, has_values = FrameRenderer(film, (300, 240)), FrameRenderer(replace(film, curves=curve), (300, 240))
    assert has_values.camera.height < plain.camera.height
    below = has_values.camera.height
    assert (has_values.pixels(0)[below:] != has_values.pixels(5)[below:]).any()  # the mark runs


@pytest.mark.parametrize("size", [(120, 120), (200, 160), (400, 171)])
def test_the_curve_has_its_place_also_on_the_smallest_picture(film, size):
    """A seventh of a low picture is less than the curve's labels take."""
    sheet = film.sheets["cloth"]
    coloured = {"cloth": replace(sheet, values=np.ones(sheet.vertices.shape[:2], np.float32))}
    curve = {"distance": Curve(film.times, np.linspace(1, 3, 6), "mm")}
    renderer = FrameRenderer(replace(film, sheets=coloured, curves=curve), size)
    below = renderer.camera.height
    assert below > 0.5 * size[1]
    first, last = renderer.pixels(0), renderer.pixels(5)
    assert first.shape == (size[1], size[0], 3)
    assert (first[below:] != last[below:]).any()


def test_a_failure_leaves_nothing_behind(film, tmp_path, monkeypatch):
    old = tmp_path / "a.gif"
    old.write_text("mine")
    monkeypatch.setattr(Image.Image, "save", lambda *_, **__: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        write_gif(film, old, size=(200, 160))
    assert old.read_text() == "mine"
    assert len(list(tmp_path.iterdir())) == 1
