"""Results of the last requests are cached, and returned only for the same request."""

import pytest
import torch

from torchcloth import Trajectory
from torchcloth._utils.caching import LRUCache, value_key
from torchcloth.boundaries import sample_trajectory
from torchcloth.boundaries.motion import check_trajectory
from torchcloth.errors import InvalidInput
from torchcloth.simulation.initial_state import stationary_motion

TIMES = torch.linspace(0.0, 1.0, 9, dtype=torch.float64)


def path(speed=0.1):
    pose = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    pose[:, 0, 3] = speed * torch.arange(3.0)
    return Trajectory(torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64), pose, torch.ones(3, dtype=torch.bool))


def test_the_last_ones_are_kept_as_far_as_memory_goes():
    asked, recent = [], LRUCache(100, lambda value: 40)

    def of(key):
        return recent.get_or_compute(key, lambda: asked.append(key) or [key])

    first = of(("a", b"8 bytes."))
    assert of(("a", b"8 bytes.")) is first
    of("b")
    assert of(("a", b"8 bytes.")) is first
    of("c")  # 48 and twice 40 are more than 100: the one that nobody asked for since goes
    assert of(("a", b"8 bytes.")) is first
    of("b")
    assert asked == [("a", b"8 bytes."), "b", "c", "b"]


def test_what_is_larger_than_all_memory_drives_nothing_out():
    recent = LRUCache(100, len)
    small, large = recent.get_or_compute("small", lambda: [0] * 50), recent.get_or_compute("large", lambda: [0] * 101)
    assert recent.get_or_compute("small", list) is small
    assert recent.get_or_compute("large", lambda: [1]) != large


def test_what_fails_is_asked_again():
    recent = LRUCache(100, len)
    for _ in range(2):
        with pytest.raises(ZeroDivisionError):
            recent.get_or_compute("a", lambda: [1 / 0])
    assert recent.get_or_compute("a", lambda: [1]) == [1]


def test_equal_motions_are_resolved_once():
    assert sample_trajectory(path(), TIMES) is sample_trajectory(path(), TIMES.clone())
    assert sample_trajectory(path(), TIMES) is not sample_trajectory(path(), TIMES[:-1])
    assert (
        stationary_motion({"hand": path()}, 0.2, 0.5)["hand"] is stationary_motion({"hand": path()}, 0.2, 0.5)["hand"]
    )


def test_who_writes_to_a_motion_gets_another():
    """By numpy, which torch does not notice."""
    motion = path()
    before = sample_trajectory(motion, TIMES), stationary_motion({"hand": motion}, 0.5, 1.0)["hand"]
    motion.pose.numpy()[:, 1, 3] = 2.0
    assert before[0].pose[0, 1, 3] == 0.0
    assert before[1].pose[0, 1, 3] == 0.0
    assert sample_trajectory(motion, TIMES).pose[0, 1, 3] == 2.0
    assert stationary_motion({"hand": motion}, 0.5, 1.0)["hand"].pose[0, 1, 3] == 2.0


def test_a_motion_that_was_sound_is_not_sound_for_ever():
    motion = path()
    check_trajectory(motion, "hand")
    check_trajectory(motion, "hand")
    motion.pose.numpy()[1, 0, 0] = 3.0
    for _ in range(2):
        with pytest.raises(InvalidInput, match="not rotations"):
            check_trajectory(motion, "hand")


def test_every_graph_is_its_own():
    motion = path()
    sample_trajectory(motion, TIMES)
    for _ in range(2):
        pose = motion.pose.clone().requires_grad_()
        sample_trajectory(motion._replace(pose=pose), TIMES).pose.sum().backward()
        assert pose.grad is not None
        assert pose.grad.abs().sum() > 0
    moved = torch.func.jvp(
        lambda p: sample_trajectory(motion._replace(pose=p), TIMES).pose, (motion.pose,), (motion.pose,)
    )[1]
    assert moved.abs().sum() > 0


def test_what_inference_mode_makes_stays_there():
    with torch.inference_mode():
        inferred = sample_trajectory(path(0.3), TIMES)
    again = sample_trajectory(path(0.3), TIMES)
    assert inferred.pose.is_inference()
    assert not again.pose.is_inference()


@pytest.mark.parametrize(
    "tensor",
    [
        torch.ones(2, requires_grad=True),
        torch.ones(2, dtype=torch.bfloat16),
        torch.ones(2, device="meta"),
        torch.ones(2).to_sparse(),
        torch.nn.Parameter(torch.ones(2)),
    ],
)
def test_more_than_numbers_have_no_content(tensor):
    assert value_key(torch.ones(2), tensor) is None


def test_content_tells_shape_precision_and_numbers():
    zeros = [torch.zeros(2), torch.zeros(2, 1), torch.zeros(1).double(), torch.zeros(8, dtype=torch.bool)]
    assert len({value_key(t) for t in (*zeros, torch.zeros(2) + 1e-9, torch.ones(2)[::2])}) == 6
    assert value_key(torch.arange(4.0)[::2]) == value_key(torch.tensor([0.0, 2.0]))
