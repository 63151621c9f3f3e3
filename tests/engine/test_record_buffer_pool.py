"""Records are written where those of the gradient before were, and never where somebody still reads."""

import threading

import pytest
import torch

import torchcloth as tc
from torchcloth.engine import execution
from torchcloth.engine.record_buffer_pool import MIN_POOLED_BYTES, RecordBufferPool

MB = 2**20


def lend(pool, megabytes):
    return pool.acquire(megabytes * MB // 4, dtype=torch.float32)


def test_a_block_comes_back_when_nothing_holds_it():
    pool = RecordBufferPool(10 * MB)
    first = lend(pool, 3)
    at, part = first.data_ptr(), first[5:9]
    del first
    second = lend(pool, 3)
    assert second.data_ptr() != at, "a part of the block is still in use"
    del part
    assert pool.pending_bytes == 3 * MB
    third = lend(pool, 3)
    assert third.data_ptr() == at
    assert pool.pending_bytes == 0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_block_is_a_tensor_like_others(dtype):
    pool = RecordBufferPool(10 * MB)
    for shape in [(2, 3), (4, MIN_POOLED_BYTES)]:
        block = pool.acquire(*shape, dtype=dtype)
        assert block.shape == shape
        assert block.dtype == dtype
        assert block.is_contiguous()
        assert block.data_ptr() % execution.RECORD_ALIGNMENT_BYTES == 0
        assert torch.equal(block.fill_(1.5).clone(), torch.full(shape, 1.5, dtype=dtype))
    with torch.device("meta"):
        assert pool.acquire(MIN_POOLED_BYTES, dtype=dtype).device.type == "cpu"


def test_block_and_waiting_blocks_are_few_together():
    pool = RecordBufferPool(10 * MB)
    blocks = [lend(pool, 2) for _ in range(5)]
    del blocks
    assert pool.pending_bytes == 10 * MB
    other = [lend(pool, 3) for _ in range(2)]  # of another cloth
    assert pool.pending_bytes <= 4 * MB
    many = [lend(pool, 3) for _ in range(4)]
    assert pool.pending_bytes == 0
    assert len(other + many) == 6
    del other, many
    assert pool.pending_bytes <= 10 * MB


def test_threads_share_a_pool():
    pool, wrong = RecordBufferPool(8 * MB), []

    def work(number):
        for _ in range(200):
            block = lend(pool, 1 + number % 2)
            block.fill_(number)
            if not bool((block == number).all()):
                wrong.append(number)

    threads = [threading.Thread(target=work, args=(i,)) for i in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong
    assert pool.pending_bytes <= 8 * MB
    assert not pool._in_use


def test_gradients_share_memory_and_nothing_else(monkeypatch):
    """Graphs that live at once have records of their own; a later one writes to theirs."""
    monkeypatch.setattr(execution, "RECORD_BUFFERS", RecordBufferPool(execution.RECORD_BUDGET_BYTES))
    mesh = tc.meshes.rectangle(0.3, 0.3, resolution=(20, 20))
    cloth = tc.Cloth(mesh, tc.materials.AEP(1e5), 0.2, {"g": tc.effects.Gravity()}, contact=None, engine="fused")

    def graph(stretch):
        x = (cloth.rest_state().x * stretch).requires_grad_()
        return x, cloth(cloth.state(x), times=[0.0, 0.1, 0.2]).x.square().sum()

    def gradient(x, loss):
        return torch.autograd.grad(loss, x)[0]

    alone = [gradient(*graph(stretch)) for stretch in (1.01, 1.02)]
    waiting = execution.RECORD_BUFFERS.pending_bytes
    assert waiting > 0
    first, second = graph(1.01), graph(1.02)
    assert torch.equal(gradient(*second), alone[1])
    assert torch.equal(gradient(*first), alone[0])
    assert execution.RECORD_BUFFERS.pending_bytes <= 2 * waiting, "and no more than two graphs need"
    assert not torch.equal(*alone)
