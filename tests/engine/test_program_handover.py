"""A program reaches the library whole or not at all, and memory that runs out ends a call, not Python."""

import os
import signal
import subprocess
import sys
from contextlib import nullcontext

import numpy as np
import pytest
import torch

import torchcloth as tc
from torchcloth.engine import program

pytestmark = pytest.mark.slow  # processes that fork, and that run out of memory


def falling(density):
    mesh = tc.meshes.rectangle(0.1, 0.1, resolution=(3, 4))
    cloth = tc.Cloth(
        mesh, tc.materials.AEP(1e5, 0.3), density, {"g": tc.effects.Gravity()}, contact=None, engine="fused"
    )
    with torch.no_grad():
        return cloth(cloth.rest_state(), times=[0.0, 0.01]).x[-1, :, 2]


@pytest.mark.parametrize("at", [0, 1, 7])
def test_an_interrupted_program_is_made_anew(monkeypatch, at):
    """Half of one, saved for later, would be a cloth without gravity, or a crash."""
    monkeypatch.setattr(program, "_cache", type(program._cache)())
    call, made = program.Program._call, []

    def interrupted(self, name, *arguments):
        if name != "free":  # of a program of an earlier test
            made.append(name)
            if len(made) == at + 1:
                raise KeyboardInterrupt
        return call(self, name, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(program.Program, "_call", interrupted)
        with pytest.raises(KeyboardInterrupt):
            falling(0.2)
    torch.testing.assert_close(falling(0.2), torch.full((12,), -0.5 * 9.81 * 1e-4), rtol=0.1, atol=0)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="nothing forks here")
def test_a_fork_does_not_wait_for_a_thread_that_it_has_not():
    """Another thread of the parent was just handing a program over."""
    with program._cache_lock:
        child = os.fork()
        if child == 0:
            signal.alarm(30)
            os._exit(0 if falling(0.31).isfinite().all() else 1)
    assert os.waitpid(child, 0)[1] == 0


def test_records_may_come_back_from_elsewhere():
    """A hook keeps what a backward pass needs where it likes: not where vectors may be read from."""

    def away(tensor):
        if not tensor.is_floating_point() or tensor.requires_grad:
            return tensor
        memory = np.empty(tensor.numel() + 16)
        shift = (-memory.ctypes.data) % 64 // 8 + 2
        place = memory[shift : shift + tensor.numel()].reshape(tensor.shape)
        place[...] = tensor.numpy()
        return place

    def back(saved):
        return torch.from_numpy(saved) if isinstance(saved, np.ndarray) else saved

    mesh = tc.meshes.rectangle(0.1, 0.1, resolution=(5, 5))
    cloth = tc.Cloth(mesh, tc.materials.AEP(1e5), 0.2, {"g": tc.effects.Gravity()}, contact=None, engine="fused")
    results = []
    for hooks in (nullcontext(), torch.autograd.graph.saved_tensors_hooks(away, back)):
        x = cloth.rest_state().x.clone().requires_grad_()
        with hooks:
            out = cloth(cloth.state(x), times=[0.0, 0.005]).x[-1]
        results.append(torch.autograd.grad(out.square().sum(), x)[0])
    assert torch.equal(*results)


SHORT = """
import resource, sys, torch, torchcloth as tc
torch.set_num_threads(16)
def cloth(n):
    mesh = tc.meshes.rectangle(0.3, 0.3, resolution=(n, n))
    effects = {"g": tc.effects.Gravity(), "b": tc.effects.Bending(1e-5)}
    return tc.Cloth(mesh, tc.materials.AEP(1e5, 0.3), 0.2, effects, contact=None, engine="fused")
few, many = cloth(4), cloth(60)
with torch.no_grad():
    scenes = [c.state(c.rest_state().x.expand(16, -1, -1).contiguous()) for c in (few, many)]
    known = [c(c.rest_state(), times=[0.0, 0.001]).x for c in (few, many)]
    used = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
    for limit in (used + int(sys.argv[1]) * 2**20, resource.RLIM_INFINITY):
        resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))
        for c, state, alone in zip((few, many), scenes, known):
            try:
                torch.testing.assert_close(c(state, times=[0.0, 0.001]).x[7], alone, rtol=0, atol=1e-6)
                print("done")
            except (MemoryError, RuntimeError) as error:
                print(type(error).__name__, error)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="limits of memory as Linux has them")
@pytest.mark.parametrize("megabytes", [8, 16, 40])  # with less, new threads end the process in the C library
def test_too_little_memory_is_an_error(megabytes):
    done = subprocess.run([sys.executable, "-c", SHORT, str(megabytes)], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr[-2000:]
    few, many, *after = done.stdout.splitlines()
    assert after == ["done", "done"]
    assert few == "done" or megabytes < 16
    assert many != "done"
