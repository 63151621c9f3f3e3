"""Scenes, clouds and batches of the training data of the pose network."""

import math
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("lightning")
try:
    import open3d  # noqa: F401
except (ImportError, OSError) as error:
    pytest.skip(f"open3d: {error}", allow_module_level=True)

from torchcloth.errors import InvalidInput, RecordingError
from torchcloth.losses import find_closest_points
from torchcloth.meshes import rectangle
from torchcloth.observe import DepthCamera, DepthNoise, look_at
from torchcloth.training.pose import clouds, data, scenes
from torchcloth.training.pose import motions as pose_motions

TABLE_SEED, HANGING_SEED = 24, 72  # a sheet that is lifted from a table by a corner; one that hangs by two
FAST_DATA = {"schema": np.array(pose_motions.DATA_SCHEMA), "rejected": np.array("")}


@pytest.fixture(scope="module")
def motions() -> dict[int, dict[str, Any]]:
    """Motions of two seeds of the training."""
    return {seed: pose_motions.make_motion(seed, "train") for seed in (TABLE_SEED, HANGING_SEED)}


@pytest.fixture(scope="module")
def samples(motions, tmp_path_factory) -> list[data.PoseSample]:
    """All samples of these motions, through their files."""
    folder = tmp_path_factory.mktemp("motions")
    for seed, motion in motions.items():
        np.savez(pose_motions.motion_path(folder, seed), **motion)
    dataset = data.PoseDataset(folder)
    return [dataset[k] for k in range(len(dataset))]


def test_the_same_seed_makes_the_same_motion(motions):
    again = pose_motions.make_motion(TABLE_SEED, "train")
    assert again.keys() == motions[TABLE_SEED].keys()
    for name, value in motions[TABLE_SEED].items():
        if value.dtype.kind == "f":  # a matrix product may depend on where its operands lie in memory
            np.testing.assert_allclose(value, again[name], rtol=0, atol=1e-6, err_msg=name)
        else:
            np.testing.assert_array_equal(value, again[name], err_msg=name)


def test_fabrics_of_the_splits_do_not_overlap():
    rng = np.random.default_rng(0)
    limits = scenes.TRAINING_FABRIC_LIMITS
    for _ in range(200):
        known, novel = (scenes._draw_fabric(rng, is_novel)._asdict() for is_novel in (False, True))
        assert all(known[name] <= limit for name, limit in limits.items())
        assert sum(novel[name] > limit for name, limit in limits.items()) == 1


def test_splits_have_other_scenes_and_each_novelty_is_new_to_the_training():
    training = [scenes.build_scene(seed, "train") for seed in (TABLE_SEED, HANGING_SEED)]
    for scene in training:
        other = scenes.build_scene(scene.seed, "held-out")
        assert not np.array_equal(scene.shape.mesh.vertices, other.shape.mesh.vertices)
        assert (scene.motion_kind in scenes.NOVEL_MOTIONS) is False
        assert (other.motion_kind in scenes.NOVEL_MOTIONS) is (other.novelty == "motion")
    assert not set(scenes.NOVEL_GARMENTS) & set(scenes.TRAINING_GARMENTS)
    assert not set(scenes.NOVEL_MOTIONS) & {*scenes.HANGING_MOTIONS, *scenes.TABLE_MOTIONS}


def test_points_lie_near_the_true_surface(samples):
    distances = []
    for sample in samples:
        points, x = (torch.as_tensor(a).double() for a in (sample.points[~sample.is_stray], sample.x))
        faces = torch.as_tensor(sample.motion["faces"]).long()
        distances.append((points - find_closest_points(points, x, faces).interpolate(x)).norm(dim=-1))
        assert sample.is_stray.mean() < 0.06  # 3 % on average at most, drawn by a binomial of 256 points
    distance = torch.cat(distances)
    assert (
        float(distance.quantile(0.97)) < 0.045
    )  # bias of the device, pose of the camera, noise; the rest: flying pixels
    assert float(distance.median()) < 0.03


def test_grippers_hold_the_vertices_that_they_are_said_to_hold(samples):
    for sample in samples:
        slack = 0.008 + 0.06 * np.nan_to_num(np.linalg.norm(sample.grip_velocity, axis=-1))  # errors, and the lag
        for k in (1, 2):
            index = np.flatnonzero(sample.grip == k)
            assert bool(len(index)) is bool(np.isfinite(sample.grip_position[k - 1]).all())
            if len(index):
                assert np.linalg.norm(sample.grip_position[k - 1] - sample.x[index].mean(0)) < slack[k - 1]
                corners = np.abs(sample.rest[index, :2] - sample.rest[:, :2].max(0))
                assert corners[:, 1].max() < 0.031  # of these sheets the upper corners


def test_the_estimate_of_the_frame_before_is_wrong_by_millimetres(samples):
    present = [sample for sample in samples if np.isfinite(sample.previous).all()]
    assert 0 < len(present) < len(samples)
    for sample in present:
        before = sample.x - sample.v * scenes.POSE_FRAME_PERIOD_S
        assert math.sqrt(((sample.previous - before) ** 2).sum(-1).mean()) < 0.03


def test_next_clouds_follow_at_the_frame_rate(samples):
    counts = [int(np.isfinite(sample.next_times).sum()) for sample in samples]
    assert set(counts) == {0, 1, 2}
    for sample in samples:
        present = np.isfinite(sample.next_times)
        np.testing.assert_array_equal(np.isfinite(sample.next_points).all((1, 2)), present)
        expected = scenes.POSE_FRAME_PERIOD_S * np.arange(1, 3)[present]
        np.testing.assert_allclose(sample.next_times[present], expected, atol=1e-5)


def test_hidden_layers_have_no_points():
    scene = scenes.build_scene(HANGING_SEED, "train")
    mesh = rectangle(0.4, 0.2, triangles=64)
    uv = mesh.vertices[:, :2]
    back = uv[:, 0] > 0.2
    x = np.column_stack([np.where(back, 0.05, 0.0), np.where(back, 0.4 - uv[:, 0], uv[:, 0]), uv[:, 1]])
    shape = scene.shape._replace(true_mesh=mesh)
    scene = scene._replace(shape=shape, has_table=False)
    pose = look_at(np.array([-1.0, 0.1, 0.1]), np.array([0.0, 0.1, 0.1]))
    K = np.array([[120.0, 0.0, 79.5], [0.0, 120.0, 71.5], [0.0, 0.0, 1.0]])
    setup = clouds.SensorSetup(DepthCamera(160, 144, K, pose), pose, DepthNoise(edge_range=9.0), None, 0, 0.0, 0.0, 0.0)
    captured = clouds._capture(
        setup, x, scene, clouds.place_arm(_far_box(), np.eye(4)), x[:1], np.random.default_rng(0)
    )
    assert captured is not None
    points, is_stray, visible = captured
    assert points.shape == (clouds.POINT_COUNT, 3)
    assert not is_stray.any()
    assert visible == 1.0
    assert (points[:, 0] < 0.03).all()


def _far_box() -> clouds.Arm:
    pose = np.eye(4)
    pose[:3, 3] = 5.0
    return clouds.Arm([((0.1, 0.1, 0.1), pose)])


def test_thinning_is_even_over_the_surface_and_not_over_pixels():
    rng = np.random.default_rng(0)
    dense, sparse = rng.random((3000, 2)) * [0.2, 0.4], [0.2, 0.0] + rng.random((600, 2)) * [0.2, 0.4]
    flat = np.column_stack([np.concatenate([dense, sparse]), np.zeros(3600)])
    thinned = clouds.thin_uniformly(flat, 200, 0.16, rng)
    assert len(np.unique(thinned, axis=0)) == 200
    assert 0.35 < (thinned[:, 0] > 0.2).mean() < 0.6
    assert len(clouds.thin_uniformly(flat[:50], 200, 0.16, rng)) == 200


@pytest.fixture
def fast_data(monkeypatch) -> list[int]:
    """Replace the simulation; return the seeds that are made."""
    made = []

    def make_motion(seed: int, split: str) -> dict[str, np.ndarray]:
        made.append(seed)
        empty = np.zeros((2, 1, 3))
        return FAST_DATA | {"times": np.zeros(2), "points": empty, "x": empty}

    monkeypatch.setattr(pose_motions, "make_motion", make_motion)
    return made


def test_a_stopped_command_goes_on_where_it_was(fast_data, tmp_path, capsys):
    out = tmp_path / "data"
    assert pose_motions.main(["--out", str(out), "--motions", "4"]) == 0
    assert "4/4 motions (100%), 8 samples" in capsys.readouterr().out
    assert pose_motions.main(["--out", str(out), "--motions", "6"]) == 0
    assert fast_data == [0, 1, 2, 3, 4, 5]
    assert {path.name for path in out.iterdir()} == {"data.json", *(f"motion_{k:06d}.npz" for k in range(6))}


def test_a_damaged_file_is_refused_with_its_name(fast_data, tmp_path, capsys):
    out = tmp_path / "data"
    pose_motions.main(["--out", str(out), "--motions", "2"])
    path = pose_motions.motion_path(out, 1)
    path.write_bytes(path.read_bytes()[:300])
    capsys.readouterr()
    assert pose_motions.main(["--out", str(out), "--motions", "3"]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert f"{path}: damaged" in message
    with pytest.raises(RecordingError, match=r"motion_000001\.npz: damaged.*delete it"):
        pose_motions.load_motion(path)


def test_a_folder_of_another_split_is_refused(fast_data, tmp_path, capsys):
    pose_motions.main(["--out", str(tmp_path), "--motions", "1"])
    assert pose_motions.main(["--out", str(tmp_path), "--motions", "1", "--split", "held-out"]) == 2
    assert "held-out" in capsys.readouterr().err
    with pytest.raises(InvalidInput, match="--motions"):
        pose_motions.make_data(tmp_path, 0, "train")


def test_files_of_another_schema_and_pickles_are_refused(tmp_path):
    path = tmp_path / "motion_000000.npz"
    np.savez(path, **FAST_DATA | {"schema": np.array("other/1"), "times": [], "points": np.zeros((0, 1)), "x": []})
    with pytest.raises(RecordingError, match="schema; got other/1"):
        pose_motions.load_motion(path)
    np.savez(path, **FAST_DATA, times=np.array([None]))
    with pytest.raises(RecordingError, match="damaged"):
        pose_motions.load_motion(path)
    with pytest.raises(InvalidInput, match="without motions"):
        data.PoseDataset(tmp_path / "nowhere")


def test_batches_are_padded_to_their_largest_mesh(samples):
    batch = data.collate([samples[0], samples[-1]])
    counts = [len(samples[0].rest), len(samples[-1].rest)]
    assert counts[0] != counts[1]
    assert batch.inputs.exists.sum(1).tolist() == counts
    assert batch.x.shape == (2, max(counts), 3)
    assert batch.inputs.points.shape == (2, clouds.POINT_COUNT, 3)
    np.testing.assert_array_equal(batch.x[1, : counts[1]].numpy(), samples[-1].x)
    assert not batch.inputs.grip[~batch.inputs.exists].any()
    assert batch.inputs.previous[~batch.inputs.exists].isnan().all()


def test_augmentation_moves_all_of_a_scene_together(samples):
    batch = data.collate(samples[::4])
    still = data.Augmentation(cut=0.0, patches=0.0, noise=0.0, shift=0.0, grip_noise=0.0, drop_previous=0.0)
    moved = data.augment(batch, still, torch.Generator().manual_seed(0))
    for before, after in (
        (torch.cdist(batch.inputs.points, batch.x), torch.cdist(moved.inputs.points, moved.x)),
        (torch.cdist(batch.x, batch.inputs.grip_position), torch.cdist(moved.x, moved.inputs.grip_position)),
        (torch.cdist(batch.inputs.rest, batch.inputs.rest), torch.cdist(moved.inputs.rest, moved.inputs.rest)),
        (batch.x[..., 2], moved.x[..., 2]),
        (torch.einsum("bij,bvj->bvi", moved.world_map, batch.v), moved.v),
    ):
        torch.testing.assert_close(before, after, atol=2e-3, rtol=0, equal_nan=True)
    handed = torch.linalg.det(moved.world_map)
    assert set(handed.round().tolist()) == {-1.0, 1.0}
    turned_rest = moved.inputs.rest[..., 0].sum(1).sign() * batch.inputs.rest[..., 0].sum(1).sign()
    torch.testing.assert_close(turned_rest, handed.round())  # left stays left


def test_augmentation_often_hides_a_third_of_a_cloud_but_never_all(samples):
    batch = data.collate(samples)
    generator = torch.Generator().manual_seed(1)
    distinct = []
    for _ in range(4):
        points = data._hide_parts(batch.inputs.points, data.Augmentation(), generator)
        distinct += [len(one.unique(dim=0)) / clouds.POINT_COUNT for one in points]
    assert 0.2 < np.mean(np.array(distinct) < 0.7) < 0.8
    assert min(distinct) >= 0.05


def test_each_epoch_serves_every_sample_once_in_another_order_with_little_padding():
    sizes = np.random.default_rng(0).integers(50, 250, 1003)
    sampler = data.SizeBucketSampler(sizes, 16, seed=3)
    epochs = [list(sampler) for _ in range(2)]
    for batches in epochs:
        assert sorted(k for batch in batches for k in batch) == list(range(1003))
        assert len(batches) == len(sampler)
        assert sum(len(batch) * sizes[batch].max() for batch in batches) < 1.1 * sizes.sum()
    assert epochs[0] != epochs[1]
    assert list(data.SizeBucketSampler(sizes, 16, seed=3)) == epochs[0]


def test_the_data_module_serves_reproducible_batches(motions, tmp_path):
    for seed, motion in motions.items():
        np.savez(pose_motions.motion_path(tmp_path, seed), **motion)
    np.savez(pose_motions.motion_path(tmp_path, 99), **{**FAST_DATA, "rejected": np.array("diverged")})
    first, second = (
        list(data.PoseDataModule(tmp_path, 8, validation_folder=tmp_path, seed=5).train_dataloader()) for _ in range(2)
    )
    assert sum(len(batch.x) for batch in first) == sum(len(motion["times"]) for motion in motions.values())
    for a, b in zip(first, second, strict=True):
        torch.testing.assert_close(a.inputs, b.inputs, equal_nan=True)
    module = data.PoseDataModule(tmp_path, 8, validation_folder=tmp_path)
    assert sum(len(batch.x) for batch in module.val_dataloader()) == sum(len(batch.x) for batch in first)
