"""The pose network: its symmetries, its padding, and its file."""

from __future__ import annotations

import pytest
import torch
from safetensors.torch import save_file

from torchcloth import meshes
from torchcloth.errors import InvalidInput
from torchcloth.pose.first_shape import load_network, save_network
from torchcloth.pose.network import PoseEstimator, PoseNetworkConfig
from torchcloth.pose.scene_frame import PoseInputs, build_scene_frame, move_to_grippers, rest_coordinates

SMALL = PoseNetworkConfig(width=16, heads=2, point_blocks=1, latents=4, vertex_blocks=1, refinements=2, hypotheses=3)
SHEET = meshes.rectangle(0.4, 0.3, triangles=60)


@pytest.fixture
def network():
    torch.manual_seed(3)
    return PoseEstimator(SMALL).double().eval()


def make_inputs(grips: int = 2, seed: int = 0) -> PoseInputs:
    """A sheet in one or two grippers, and a cloud of it."""
    generator = torch.Generator().manual_seed(seed)
    rest = rest_coordinates(SHEET).double()
    u, v = rest[:, 0], rest[:, 1]
    grip = torch.zeros(len(rest), dtype=torch.int64)
    grip[(u < 1e-6) & (v > 0.3 - 1e-6)] = 1
    grip[(u > 0.4 - 1e-6) & (v > 0.3 - 1e-6)] = 2 if grips == 2 else 0
    position = torch.tensor([[0.5, -0.2, 0.6], [0.6, 0.15, 0.65]]).double()
    position[grips:] = torch.nan
    cloud = torch.rand(80, 3, generator=generator).double() * torch.tensor([0.1, 0.4, 0.3]) + torch.tensor(
        [0.5, -0.2, 0.3]
    )
    velocity = torch.randn(2, 3, generator=generator).double()
    exists, before = torch.ones(len(rest), dtype=torch.bool), torch.full((len(rest), 3), torch.nan).double()
    return PoseInputs(*(x[None] for x in (cloud, rest, exists, grip, position, velocity, before)))


def turn(inputs: PoseInputs, angle: float, shift: torch.Tensor) -> tuple[PoseInputs, torch.Tensor]:
    """The scene, turned about the vertical and moved; and the rotation."""
    c, s = torch.tensor(angle).cos(), torch.tensor(angle).sin()
    R = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).double()
    moved = {name: getattr(inputs, name) @ R.T + shift for name in ("points", "grip_position", "previous")}
    return inputs._replace(**moved, grip_velocity=inputs.grip_velocity @ R.T), R


@pytest.mark.parametrize("with_previous", [False, True])
@pytest.mark.parametrize("grips", [1, 2])
def test_the_answer_turns_and_moves_with_the_scene(network, grips, with_previous):
    inputs = make_inputs(grips)
    if with_previous:
        inputs = inputs._replace(previous=inputs.rest @ torch.tensor([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]).double())
    before = network(inputs)
    shift = torch.tensor([1.0, -2.0, 0.5]).double()
    # a cloud alone tells its long axis, not its direction: turn by less than a quarter
    moved, R = turn(inputs, 0.3, shift)
    after = network(moved)
    torch.testing.assert_close(after.x, before.x @ R.T + shift, rtol=0, atol=1e-9)
    torch.testing.assert_close(after.v, before.v @ R.T, rtol=0, atol=1e-9)
    torch.testing.assert_close(after.std, before.std)


def test_the_order_of_points_and_grippers_does_not_matter(network):
    inputs = make_inputs()
    order = torch.randperm(80, generator=torch.Generator().manual_seed(1))
    shuffled = inputs._replace(
        points=inputs.points[:, order],
        grip=torch.tensor([0, 2, 1])[inputs.grip],
        grip_position=inputs.grip_position.flip(1),
        grip_velocity=inputs.grip_velocity.flip(1),
    )
    a, b = build_scene_frame(inputs), build_scene_frame(shuffled)
    for x, y in zip(a, b, strict=True):
        torch.testing.assert_close(x, y)
    reordered = inputs._replace(points=inputs.points[:, order])
    torch.testing.assert_close(network(reordered).x, network(inputs).x, rtol=0, atol=1e-9)


def test_where_the_pattern_lies_in_its_plane_does_not_matter(network):
    """A pattern that is drawn elsewhere and turned by a quarter is the same fabric."""
    inputs = make_inputs()
    turned = inputs.rest @ torch.tensor([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]).double() + 0.7
    torch.testing.assert_close(network(inputs._replace(rest=turned)).x, network(inputs).x, rtol=0, atol=1e-9)


def test_padding_changes_nothing(network):
    inputs = make_inputs()
    count = inputs.rest.shape[1]
    pad = torch.nn.functional.pad
    padded = inputs._replace(
        rest=pad(inputs.rest, (0, 0, 0, 7), value=3.0),
        exists=pad(inputs.exists, (0, 7)),
        grip=pad(inputs.grip, (0, 7)),
        previous=pad(inputs.previous, (0, 0, 0, 7), value=torch.nan),
    )
    a, b = network(inputs), network(padded)
    torch.testing.assert_close(b.x[:, :count], a.x, rtol=0, atol=1e-9)
    torch.testing.assert_close(b.log_fabric, a.log_fabric)


def test_an_untrained_network_lets_the_sheet_hang_from_the_grippers(network):
    inputs = make_inputs()
    x = network(inputs).x[0]
    held = inputs.grip[0] == 1
    assert (x[held].mean(0) - inputs.grip_position[0, 0]).norm() < 0.05
    assert (x[:, 2].max() - x[:, 2].min() - 0.3).abs() < 0.1


def test_hypotheses_come_with_their_weights(network):
    prediction = network(make_inputs(), samples=3)
    count = make_inputs().rest.shape[1]
    assert prediction.hypotheses.shape == (1, 3, count, 3)
    assert bool((prediction.weights.diff() <= 0).all())
    assert float(prediction.weights.sum().detach()) == pytest.approx(1.0)
    torch.testing.assert_close(prediction.hypotheses[:, 0], prediction.x)
    with pytest.raises(InvalidInput, match="samples"):
        network(make_inputs(), samples=4)


def test_the_usual_network_is_small():
    assert sum(p.numel() for p in PoseEstimator().parameters()) < 2_000_000


def test_gradients_reach_the_points(network):
    """As finite differences say: a cloud may come from something that is learned itself."""
    inputs = make_inputs()
    points = inputs.points.clone().requires_grad_()
    direction = torch.randn(points.shape, generator=torch.Generator().manual_seed(5)).double()

    def value(points):
        return network(inputs._replace(points=points)).x.square().sum()

    (gradient,) = torch.autograd.grad(value(points), points)
    step = 1e-6
    with torch.no_grad():
        difference = (value(points + step * direction) - value(points - step * direction)) / (2 * step)
    assert float((gradient * direction).sum()) == pytest.approx(float(difference), rel=1e-5)


# -- the file ---------------------------------------------------------------------------------------------------------


def test_a_network_is_read_as_it_was_written(tmp_path):
    network = PoseEstimator(SMALL)
    save_network(network, tmp_path / "network.safetensors")
    again = load_network(tmp_path / "network.safetensors")
    assert again.description == network.description
    assert not again.training
    for name, value in network.state_dict().items():
        torch.testing.assert_close(again.state_dict()[name], value.float(), rtol=1e-3, atol=1e-6)


def _damage(path, kind):
    network = PoseEstimator(SMALL)
    save_network(network, path)
    data = path.read_bytes()
    tensors = {name: value.detach().clone() for name, value in network.state_dict().items()}
    metadata = {"format": "torchcloth-pose-network-1", "config": '{"width": 16}'}
    if kind == "cut":
        path.write_bytes(data[: len(data) // 2])
    elif kind == "pickle":
        torch.save(tensors, path)
    elif kind == "huge":
        save_file(tensors, path, {**metadata, "config": '{"width": 1000000}'})
    elif kind == "format":
        save_file(tensors, path, {"config": "{}"})
    elif kind == "size":
        save_file(tensors, path, metadata)
    else:
        tensors["to_hypotheses.bias"][0] = torch.nan
        save_file(tensors, path, {**metadata, "config": str(network.description).replace("'", '"')})


@pytest.mark.parametrize("kind", ["cut", "pickle", "huge", "format", "size", "nan"])
def test_a_file_that_is_no_network_is_one_clear_error(tmp_path, kind):
    path = tmp_path / "network.safetensors"
    _damage(path, kind)
    with pytest.raises(InvalidInput, match=r"network\.safetensors: network"):
        load_network(path)


def test_a_missing_file_is_one_clear_error(tmp_path):
    with pytest.raises(InvalidInput, match="no such file"):
        load_network(tmp_path / "none.safetensors")


# -- grippers ---------------------------------------------------------------------------------------------------------


def test_what_is_held_comes_to_its_gripper_where_the_network_is_unsure():
    inputs = make_inputs()
    frame = build_scene_frame(inputs)
    x = frame.to_world(frame.hang(frame.rest_to_scene(inputs.rest)))
    shifted = x + torch.tensor([0.02, 0.0, 0.01]).double()
    resting = inputs._replace(grip_velocity=torch.zeros_like(inputs.grip_velocity))
    held = inputs.grip[0] == 1
    unsure = move_to_grippers(shifted, torch.full(x.shape[:2], 0.05).double(), resting)
    sure = move_to_grippers(shifted, torch.full(x.shape[:2], 1e-5).double(), resting)
    assert (unsure[0, held].mean(0) - inputs.grip_position[0, 0]).norm() < 1e-3
    torch.testing.assert_close(sure, shifted, rtol=0, atol=1e-5)
    lowest = x[0, :, 2].argmin()  # far from the grippers
    assert (unsure - shifted)[0, lowest].norm() < 0.3 * (unsure - shifted)[0, held].norm(dim=-1).mean()


def test_a_fast_gripper_is_believed_less_because_its_clock_may_be_off():
    inputs = make_inputs()
    x = inputs.rest.roll(1, -1) + inputs.grip_position[:, :1]
    std = torch.full(x.shape[:2], 0.01).double()
    slow, fast = (
        move_to_grippers(x, std, inputs._replace(grip_velocity=torch.full_like(inputs.grip_velocity, speed))) - x
        for speed in (0.0, 2.0)
    )
    assert float(fast.norm()) < 0.5 * float(slow.norm())
