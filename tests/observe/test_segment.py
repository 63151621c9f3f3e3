"""Cloth, table, arm and flying pixels, rendered and measured back: who is what is known per pixel."""

import numpy as np
import pytest

from torchcloth import meshes
from torchcloth.errors import InvalidInput
from torchcloth.observe import (
    DepthCamera,
    DepthNoise,
    Segmentation,
    StereoNoise,
    build_solid_mesh,
    look_at,
    render_depth,
    segment,
    segment_depth,
)

CAMERA = DepthCamera.azure_kinect_nfov(look_at([1.1, 0.5, 0.9], [0.5, 0.0, 0.05]))
GRASP = np.array([[0.5, 0.0, 0.212]])
BOX = {"workspace_low": (0.1, -0.5, -0.05), "workspace_high": (0.9, 0.5, 0.6)}
RED, GREY = (190, 30, 40), (120, 120, 120)


def pose(x, y, z):
    out = np.eye(4)
    out[:3, 3] = x, y, z
    return out


@pytest.mark.parametrize(
    "options",
    [
        {"outlier_neighbours": -1},
        {"isolation_radius": 0.01, "isolation_neighbours": 0},
        {"table_margin": np.nan},
        {"outlier_deviations": 0},
        {"outlier_deviations": np.inf},
        {"workspace_low": (-1.0, -1.0)},
        {"workspace_low": (np.nan, 0.0, 0.0)},
        {"workspace_low": (0.0, 0.0, 1.0), "workspace_high": (1.0, 1.0, 0.0)},
        {"hsv_range": (0.1, 0.2)},
        {"hsv_range": ((100, 0, 0), (140, 255, 255))},
        {"table": (0.0, 0.0, -1.0, 0.0)},
        {"table": (0.0, 0.0, 1.0, np.nan)},
        {"plane_tolerance": None, "table": "find"},
        {"grasp_distance": None},
        {"cluster_core_points": None},
        {"isolation_radius": 0.01, "isolation_neighbours": None},
    ],
    ids=str,
)
def test_stages_that_would_take_all_or_fail_are_refused(options):
    with pytest.raises(InvalidInput, match="|".join(options)):
        Segmentation(**options)


def test_colours_from_0_to_1_are_refused():
    """Taken for bytes they would all be black, and no point would be left."""
    points, colors = np.zeros((3, 3)), np.tile([0.75, 0.12, 0.16], (3, 1))
    stages = Segmentation(hsv_range=((0.95, 0.4, 0.2), (0.05, 1.0, 1.0)), outlier_neighbours=None, cluster_gap=None)
    with pytest.raises(InvalidInput, match=r"colors; got float64; expected uint8.*multiply by 255"):
        segment(points, stages, colors=colors)
    assert len(segment(points, stages, colors=(255 * colors).astype(np.uint8)).points) == 3
    with pytest.raises(InvalidInput, match=r"colors; got .*divide by 257"):
        segment(points, stages, colors=(65535 * colors).astype(np.uint16))


def test_pixels_that_are_too_far_were_not_seen():
    """Infinity (REP 118): no point, and no edge for what stands before it."""
    depth = np.zeros((CAMERA.height, CAMERA.width))
    depth[100:110, 100:110] = 1.0
    stages = Segmentation(outlier_neighbours=None, cluster_gap=None)
    plain, depth[depth == 0] = segment_depth(CAMERA, depth, stages), np.inf
    result = segment_depth(CAMERA, depth, stages)
    assert (result.input_count, result.removed) == (plain.input_count, plain.removed) == (100, {"edge": 0})
    np.testing.assert_array_equal(result.points, plain.points)


def test_corners_may_be_arrays_and_masks_bytes():
    points = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    stages = Segmentation(
        workspace_low=np.array([-1.0, -1.0, -1.0]), workspace_high=np.ones(3), outlier_neighbours=None, cluster_gap=None
    )
    assert segment(points, stages).indices.tolist() == [0]
    depth = np.full((CAMERA.height, CAMERA.width), 0.5)
    mask = np.zeros_like(depth, dtype=np.uint8)
    mask[100:102, 100:102] = 255
    assert (
        segment_depth(
            CAMERA, depth, Segmentation(max_depth_step=None, outlier_neighbours=None, cluster_gap=None), mask=mask
        ).input_count
        == 4
    )


def test_what_lies_inside_the_robot_is_the_robots():
    """Arms are thicker than what counts as near; their solids overlap."""
    solids = [build_solid_mesh("cylinder", (0.07, 0.4), pose(x, 0.0, 0.0)) for x in (0.0, 0.05)]
    points = np.array([[x, 0.0, 0.0] for x in (0.0, 0.025, 0.1, 0.125, 0.14, 0.2)])
    stages = Segmentation(outlier_neighbours=None, cluster_gap=None, robot_margin=0.012)
    assert segment(points, stages, robot=solids).indices.tolist() == [4, 5]


def test_points_around_several_solids_are_judged_as_by_each_solid_alone():
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, (2000, 3))
    solids = [build_solid_mesh("sphere", (0.1,), pose(x, 0.0, 0.1)) for x in (-0.3, 0.0, 0.25)]
    centres = np.array([[-0.3, 0.0, 0.1], [0.0, 0.0, 0.1], [0.25, 0.0, 0.1]])
    distance = np.linalg.norm(points[:, None] - centres, axis=-1).min(1) - 0.1
    stages = Segmentation(max_depth_step=None, robot_margin=0.03, outlier_neighbours=None, cluster_gap=None)
    remains = np.isin(np.arange(len(points)), segment(points, stages, robot=solids).indices)
    is_clear = np.abs(distance - 0.03) > 3e-3  # the mesh lies a little inside the sphere
    assert np.array_equal(remains[is_clear], (distance > 0.03)[is_clear])


def test_images_of_another_size_are_refused():
    depth = np.zeros((CAMERA.height, CAMERA.width))
    for wrong in ({"depth": depth[:-1]}, {"mask": depth[:, 1:] > 0}, {"colors": depth}):
        with pytest.raises(InvalidInput, match=f"{next(iter(wrong))}; got shape .* the camera's pixels"):
            segment_depth(CAMERA, stages=Segmentation(), **{"depth": depth, **wrong})


@pytest.fixture(scope="module")
def scene():
    """A 0.4 m cloth on a table, lifted in the middle by an arm; a box stands beside it."""
    cloth = meshes.rectangle(0.4, 0.4, triangles=5000)
    flat = cloth.vertices[:, :2] - 0.2
    peak = 0.2 * np.exp(-(flat**2).sum(1) / 0.07**2) + 0.012 * (1 + np.sin(40 * flat[:, 0] + 15 * flat[:, 1]))
    x = np.column_stack([flat + np.array([0.5, 0.0]), 0.002 + peak])
    arm = [
        build_solid_mesh("cylinder", (0.02, 0.3), pose(0.5, 0.0, 0.375)),
        build_solid_mesh("box", (0.08, 0.08, 0.1), pose(0.5, 0, 0.55)),
    ]
    table = build_solid_mesh("box", (1.6, 1.6, 0.04), pose(0.5, 0, -0.02))
    thing = build_solid_mesh("box", (0.1, 0.1, 0.1), pose(0.35, 0.38, 0.05))
    return {"cloth": (x, cloth.faces), "table": table, "arm": arm, "thing": thing}


@pytest.fixture(scope="module")
def image(scene):
    """Noisy depth, which pixels are cloth, and colours."""
    clean, ids = render_depth(CAMERA, [scene["cloth"], scene["table"], *scene["arm"], scene["thing"]])
    noise = DepthNoise(flying_fraction=0.5, edge_range=0.3)
    depth = noise.apply(clean, np.random.default_rng(0))
    colors = np.where((ids == 0)[..., None], RED, GREY).astype(np.uint8)
    return depth, ids == 0, colors, clean


def score(image, result):
    """Precision, recall over all cloth pixels, and recall over those 15 mm or more over the table."""
    depth, cloth, _, clean = image
    seen = depth > 0
    truth = cloth[seen]
    remaining = np.zeros(seen.sum(), bool)
    remaining[result.indices] = True
    height = CAMERA.unproject_pixels(*np.nonzero(seen), clean[seen])[:, 2]
    high = truth & (height > 0.015)
    return truth[remaining].mean(), remaining[truth].mean(), remaining[high].mean()


def test_by_shape_alone_what_stands_over_the_table_is_found(scene, image):
    stages = Segmentation(**BOX, table="find")
    result = segment_depth(CAMERA, image[0], stages, robot=scene["arm"], grasps=GRASP)
    precision, recall, high = score(image, result)
    assert precision > 0.995
    assert high > 0.93  # the rest is seen at a grazing angle, or touches the arm
    assert recall > 0.80  # 12 % of the cloth is within 6 mm of the table, and lost: that is what ``above`` says
    np.testing.assert_allclose(result.table, [0, 0, 1, 0], atol=2e-3)
    assert result.input_count - sum(result.removed.values()) == len(result.points) == len(result.indices)
    assert list(result.removed) == ["edge", "crop", "robot", "table", "outliers", "clusters"]
    assert min(result.removed.values()) > 0


def test_a_stereo_sensor_needs_a_higher_band(scene):
    camera = DepthCamera.realsense_d435(CAMERA.T_world_camera)
    clean, ids = render_depth(camera, [scene["cloth"], scene["table"], *scene["arm"], scene["thing"]])
    rng = np.random.default_rng(0)
    noise = StereoNoise.d435()
    depth = noise.apply(clean, rng, noise.bias_field(clean.shape, rng))
    truth = (ids == 0)[depth > 0]
    low, high = (
        segment_depth(
            camera,
            depth,
            Segmentation(**BOX, table="find", table_margin=above, robot_margin=0.03),
            robot=scene["arm"],
            grasps=GRASP,
        )
        for above in (0.006, 0.015)
    )
    assert truth[low.indices].mean() < 0.98
    assert truth[high.indices].mean() > 0.995
    np.testing.assert_allclose(low.table, high.table, atol=1e-9)  # whatever planes were drawn


def test_by_colour_cloth_that_lies_flat_is_found_too(scene, image):
    stages = Segmentation(**BOX, hsv_range=((0.95, 0.5, 0.3), (0.05, 1.0, 1.0)), table="find", table_margin=-0.01)
    result = segment_depth(CAMERA, image[0], stages, colors=image[2], robot=scene["arm"], grasps=GRASP)
    precision, recall, _ = score(image, result)
    assert precision > 0.995
    assert recall > 0.93


def test_without_the_robot_s_shape_the_arm_stays(scene, image):
    stages = Segmentation(**BOX, table=(0, 0, 1, 0))
    with_arm = segment_depth(CAMERA, image[0], stages, grasps=GRASP)
    without = segment_depth(CAMERA, image[0], stages, robot=scene["arm"], grasps=GRASP)
    assert score(image, with_arm)[0] < 0.95 < score(image, without)[0]


def test_edges_hold_the_flying_pixels(scene, image):
    depth, _, _, clean = image
    flown = (depth > 0) & (np.abs(depth - clean) > 0.03)
    assert flown.sum() > 100
    stages = Segmentation(outlier_neighbours=None, cluster_gap=None)
    remaining = np.zeros((depth > 0).sum(), bool)
    remaining[segment_depth(CAMERA, depth, stages).indices] = True
    assert (remaining & flown[depth > 0]).sum() < 0.02 * flown.sum()


def test_the_largest_cluster_or_the_one_that_is_held():
    rng = np.random.default_rng(0)
    big, small = rng.uniform(0, 0.1, (900, 3)), rng.uniform(0, 0.06, (300, 3)) + np.array([0.3, 0, 0])
    points = np.concatenate([big, small])
    stages = Segmentation(outlier_neighbours=None)
    assert (segment(points, stages).indices < 900).all()
    holding = segment(points, stages, grasps=np.array([[0.33, 0.03, 0.03]]))
    assert (holding.indices >= 900).all()
    assert holding.removed == {"clusters": 1200 - len(holding.points)}
    assert (
        len(segment(points, stages, grasps=np.array([[5.0, 0, 0]])).points) == 0
    )  # nothing is held: said, not guessed


def test_outliers_thinning_and_normals():
    rng = np.random.default_rng(0)
    plane = np.column_stack([rng.uniform(-0.1, 0.1, (4000, 2)), 0.001 * rng.standard_normal(4000)])
    points = np.concatenate([plane, rng.uniform(-0.1, 0.1, (30, 3)) + np.array([0, 0, 0.3])])
    stages = Segmentation(cluster_gap=None, isolation_radius=0.01, spacing=0.01, normal_radius=0.02)
    result = segment(points, stages, viewpoint=np.array([0, 0, 1.0]))
    assert (result.indices < 4000).all()
    assert result.removed["outliers"] + result.removed["isolated"] >= 30
    assert len(np.unique(np.floor(result.points / 0.01), axis=0)) == len(result.points)
    assert np.degrees(np.arccos(result.normals[:, 2])).mean() < 8
    below = segment(points, stages, viewpoint=np.array([0, 0, -1.0]))
    assert (below.normals[:, 2] < 0).all()


def test_a_cloth_larger_than_what_is_seen_of_the_table_is_not_taken_for_it():
    rng = np.random.default_rng(0)
    table = np.column_stack([rng.uniform(-0.5, 0.5, (1500, 2)), 0.001 * rng.standard_normal(1500)])
    cloth = np.column_stack([rng.uniform(-0.5, 0.5, (6000, 2)), 0.05 + 0.001 * rng.standard_normal(6000)])
    result = segment(np.concatenate([cloth, table]), Segmentation(table="find", cluster_gap=None))
    assert result.removed["table"] == 1500
    assert abs(result.table[3]) < 1e-3


@pytest.mark.parametrize("above", [None, 0.1, 0.03])
def test_a_table_that_is_noisier_than_flat_is_found_where_it_is(above):
    """A D435 from 1.3 m: 6 mm of noise, and planes in its tails have next to nothing under them, too."""
    camera = DepthCamera.realsense_d435(look_at([0.5, 0.0, 1.3], [0.5, 0.0, 0.0], up=[1.0, 0.0, 0.0]))
    square = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    things = [(3 * square, faces)]
    if above is not None:
        things.append((0.15 * square + [0.5, 0.0, above], faces))
    depth = StereoNoise().apply(render_depth(camera, things)[0], np.random.default_rng(0))
    stages = Segmentation(table="find", outlier_neighbours=None, cluster_gap=None, max_depth_step=None)
    result = segment_depth(camera, depth, stages).table
    assert np.abs(np.array([0.5, 0.0, 0.0]) @ result[:3] + result[3]) < 2e-3
    assert result[2] > np.cos(0.005)


def test_a_table_that_is_not_there_is_said_to_be_missing():
    cube = np.random.default_rng(0).uniform(0.0, 0.3, (900, 3))
    stages = {"outlier_neighbours": None, "cluster_gap": None}
    sought = segment(cube, Segmentation(table="find", **stages))
    assert (sought.table, sought.removed, len(sought.points)) == (None, {"table": 0}, 900)
    assert segment(cube, Segmentation(**stages)).removed == {}


def test_hands_are_somewhere():
    points = np.random.default_rng(0).uniform(0.0, 0.1, (900, 3))
    for grasps in ([[np.nan] * 3], [[0.0, np.inf, 0.0]], [0.0, 0.0, 0.0], [[0.0, 0.0]]):
        with pytest.raises(InvalidInput, match="grasps"):
            segment(points, Segmentation(), grasps=np.array(grasps))


def test_nothing_comes_of_nothing_and_bad_input_is_refused():
    everything = Segmentation(**BOX, table="find", isolation_radius=0.01, spacing=0.01, normal_radius=0.02)
    empty = segment(np.zeros((0, 3)), everything)
    assert len(empty.points) == 0
    assert sum(empty.removed.values()) == 0
    assert len(segment(np.full((50, 3), 9.0), everything).points) == 0
    for bad in ({"cluster_gap": -1.0}, {"table": "guess"}, {"table": (0, 0, 2, 0)}):
        with pytest.raises(InvalidInput, match=next(iter(bad))):
            Segmentation(**bad)
    with pytest.raises(InvalidInput, match="points"):
        segment(np.full((5, 3), np.nan), Segmentation())
    with pytest.raises(InvalidInput, match="colors"):
        segment(np.zeros((5, 3)), Segmentation(hsv_range=((0, 0, 0), (1, 1, 1))))
