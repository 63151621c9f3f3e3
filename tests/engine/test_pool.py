"""Records are written where those of the gradient before were, and never where somebody still reads."""

import threading

import pytest
import torch

import torchcloth as tc
from torchcloth.engine import execution
from torchcloth.engine.record_buffer_pool import WORTH, Pool

MB = 2**20


def lend(pool, megabytes):
    return pool.lend(megabytes * MB // 4, dtype=torch.float32)


def test_a_block_comes_back_when_nothing_holds_it():
    pool = Pool(10 * MB)
    first = lend(pool, 3)
    at, part = first.data_ptr(), first[5:9]
    del first
    second = lend(pool, 3)
    assert second.data_ptr() != at, "a part is still held"
    del part
    assert pool.waiting == 3 * MB
    third = lend(pool, 3)
    assert third.data_ptr() == at
    assert pool.waiting == 0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_block_is_a_tensor_like_others(dtype):
    pool = Pool(10 * MB)
    for shape in [(2, 3), (4, WORTH)]:
        lent = pool.lend(*shape, dtype=dtype)
        assert lent.shape == shape
        assert lent.dtype == dtype
        assert lent.is_contiguous()
        assert lent.data_ptr() % execution.ALIGNED == 0
        assert torch.equal(lent.fill_(1.5).clone(), torch.full(shape, 1.5, dtype=dtype))
    with torch.device("meta"):
        assert pool.lend(WORTH, dtype=dtype).device.type == "cpu"


def test_lent_and_waiting_blocks_are_few_together():
    pool = Pool(10 * MB)
    held = [lend(pool, 2) for _ in range(5)]
    del held
    assert pool.waiting == 10 * MB
    other = [lend(pool, 3) for _ in range(2)]  # of another cloth
    assert pool.waiting <= 4 * MB
    many = [lend(pool, 3) for _ in range(4)]
    assert pool.waiting == 0
    assert len(other + many) == 6
    del other, many
    assert pool.waiting <= 10 * MB


def test_threads_share_a_pool():
    pool, wrong = Pool(8 * MB), []

    def work(number):
        for _ in range(200):
            lent = lend(pool, 1 + number % 2)
            lent.fill_(number)
            if not bool((lent == number).all()):
                wrong.append(number)

    threads = [threading.Thread(target=work, args=(i,)) for i in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
    assert pool.waiting <= 8 * MB
    assert not pool._lent


def test_gradients_share_memory_and_nothing_else(monkeypatch):
    """Graphs that live at once have records of their own; a later one writes to theirs."""
    monkeypatch.setattr(execution, "MEMORY", Pool(execution.BUDGET))
    mesh = tc.meshes.rectangle(0.3, 0.3, resolution=(20, 20))
    cloth = tc.Cloth(mesh, tc.materials.AEP(1e5), 0.2, {"g": tc.effects.Gravity()}, contact=None, engine="fused")

    def graph(stretch):
        x = (cloth.rest_state().x * stretch).requires_grad_()
        return x, cloth(cloth.state(x), times=[0.0, 0.1, 0.2]).x.square().sum()

    def gradient(x, loss):
        return torch.autograd.grad(loss, x)[0]

    alone = [gradient(*graph(stretch)) for stretch in (1.01, 1.02)]
    waiting = execution.MEMORY.waiting
    assert waiting > 0
    first, second = graph(1.01), graph(1.02)
    assert torch.equal(gradient(*second), alone[1])
    assert torch.equal(gradient(*first), alone[0])
    assert execution.MEMORY.waiting <= 2 * waiting, "and no more than two graphs need"
    assert not torch.equal(*alone)
