"""A replacement of the CUDA device: the C++ compiler builds the same source, and a block's threads run in turn.

Programs run on CPU tensors.
"""

import ctypes
import hashlib
import os
import subprocess
import tempfile
from contextlib import contextmanager, nullcontext
from functools import cache
from pathlib import Path
from unittest.mock import patch
from weakref import WeakKeyDictionary

import torch

from torchcloth.boundaries.motion import sample_trajectory
from torchcloth.engine import building, devices, execution
from torchcloth.engine.cuda import launch as runs
from torchcloth.engine.fused import FusedEngine

HOST_PREAMBLE = """
#include <cmath>
#include <condition_variable>
#include <mutex>
#include <thread>
#include <vector>
using std::atan2, std::exp, std::expm1, std::floor, std::sqrt;
#define ON_HOST
#define WARP 1
#define THREADS {threads}
static thread_local int thread_number, block_number;
static double shared_memory[1 << 16];
#define T thread_number
#define SCENE block_number
#define SYNC() next_one()
#define STAGE static
#define KERNEL extern "C" void
#define FIXED static const
#define ATOMIC_ADD added_to
#define ATOMIC_CAS exchanged
static int added_to(int* at, int more) {{ const int before = *at; *at += more; return before; }}
static unsigned long long exchanged(unsigned long long* at, unsigned long long wanted, unsigned long long other) {{
    const unsigned long long before = *at;
    if (before == wanted) *at = other;
    return before;
}}

// One thread runs at a time, in order or the other way round, each until all have to wait.
static const bool reversed = {reversed};
static std::mutex guard;
static std::condition_variable changed;
static int turn, waits;
static void begin(int round) {{
    std::unique_lock<std::mutex> lock(guard);
    changed.wait(lock, [&] {{ return waits == round && turn == (reversed ? THREADS - 1 - T : T); }});
}}
static void end() {{
    std::lock_guard<std::mutex> lock(guard);
    if (++turn == THREADS) turn = 0, waits++;
    changed.notify_all();
}}
static void next_one() {{
    if (THREADS == 1) return;
    const int round = waits;
    end(), begin(round + 1);
}}
"""
LAUNCH_FUNCTIONS = """
template <class F>
static void each(int blocks, F work) {
    for (int block = 0; block < blocks; block++) {
        turn = waits = 0;
        auto job = [&](int t) { thread_number = t, block_number = block, begin(0), work(), end(); };
        std::vector<std::thread> others;
        for (int t = 1; t < THREADS; t++) others.emplace_back(job, t);
        job(0);
        for (auto& other : others) other.join();
    }
}
extern "C" void launch_values(int blocks, Port* p, R* d, int* t, R* w, unsigned char* masks, int* grids, Count* ends,
                              int substeps, int frames, int keeps) {
    each(blocks, [&] { values(p, d, t, w, masks, grids, ends, substeps, frames, keeps); });
}
extern "C" void launch_adjoint(int blocks, Port* p, R* d, int* t, R* w, unsigned char* masks, int* grids, int substeps,
                               int first, int all) {
    each(blocks, [&] { adjoint(p, d, t, w, masks, grids, substeps, first, all); });
}
"""
BUILD_FOLDER: list[Path] = []  # one folder of compiled programs, for all processes that run tests
COMPILER_FLAGS = ["-std=c++20", "-O1", "-ffp-contract=off", "-fPIC", "-shared", "-pthread", "-w"]


@cache
def compile_program(text):
    """Compile a program once per run of the tests: a compilation takes a second."""
    library = BUILD_FOLDER[0] / f"{hashlib.sha256(text.encode()).hexdigest()}.so"
    if not library.exists():
        with tempfile.TemporaryDirectory(dir=BUILD_FOLDER[0]) as folder:
            file = Path(folder) / "program.cpp"
            file.write_text(text)
            subprocess.run([*building.compiler(), *COMPILER_FLAGS, "-o", f"{file}.so", str(file)], check=True)
            os.replace(f"{file}.so", library)
    return ctypes.CDLL(str(library))


class HostProgram:
    """A program that the host's compiler built."""

    def __init__(self, text, threads, reverse):
        self.threads = threads
        self._library = compile_program(
            HOST_PREAMBLE.format(threads=threads, reversed=str(reverse).lower()) + text + LAUNCH_FUNCTIONS
        )

    def launch(self, name, blocks, shared, arguments):
        assert shared <= 8 << 16
        getattr(self._library, f"launch_{name}")(blocks, *arguments)


@contextmanager
def replace_device_by_host(threads=1, reverse=False):
    """Run CUDA programs on the host within this context."""
    with (
        patch.object(runs, "kernels", lambda text, device: HostProgram(text, threads, reverse)),
        patch.object(runs, "_device_programs", WeakKeyDictionary()),
    ):
        yield


CHECKED_KERNELS: set[str] = set()  # in this process


def check_device_agreement(cloth, motion, state, substeps=60, dt=1e-4, stages=0, tolerances=(1e-11, 1e-9)):
    """Check values and adjoints of a program on a device, or on the host, against the CPU engine in float64.

    Compilation takes long, so programs without a kernel that is new here are skipped.
    """
    model = cloth.build_model()._replace(stages=stages)
    prescribed = {
        name: sample_trajectory(t, torch.arange(substeps + 1, dtype=torch.float64) * dt) for name, t in motion.items()
    }
    with patch.object(devices, "is_on_device", lambda tensor: True):
        fused = FusedEngine(model, state, prescribed)
    used = {str(given[0]) if name == "kernel" else name for name, given in fused.builder.program.recorded_calls}
    if used <= CHECKED_KERNELS:
        return
    CHECKED_KERNELS.update(used)
    job = fused.job(state, torch.full((substeps,), dt, dtype=torch.float64), prescribed)
    job = job._replace(inputs={f: t.detach().contiguous() for f, t in job.inputs.items()})
    ends = (substeps // 3, substeps)
    if model.grid is not None:
        ends = (substeps,)  # a frame within contact would differ
    expected, _ = execution.forward(job._replace(frame_ends=ends))
    generator = torch.Generator().manual_seed(0)
    seeds = {f: torch.randn(job.scenes, f.rows, f.comps, generator=generator, dtype=job.like.dtype) for f in expected}
    expected_gradients = execution.reverse(job, execution.forward(job, 1)[1], 1, seeds, set(job.inputs))
    device = "cuda" if torch.cuda.is_available() else "cpu"
    with replace_device_by_host() if device == "cpu" else nullcontext():
        device_job = job._replace(inputs={f: t.to(device) for f, t in job.inputs.items()})
        results, masks = runs.forward(device_job._replace(frame_ends=ends))
        gradients = runs.reverse(device_job, masks, {f: t.to(device) for f, t in seeds.items()}, set(job.inputs))
    for reference, result, tolerance in (
        (expected, results, tolerances[0]),
        (expected_gradients, gradients, tolerances[1]),
    ):
        for f, t in reference.items():
            torch.testing.assert_close(
                result[f].cpu(), t, rtol=0, atol=tolerance * float(t.abs().max()) + 1e-300, msg=str(f)
            )
