"""Limits of this machine, and how far a substep is from them."""

from __future__ import annotations

import ctypes
import os
import platform
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import torch

from torchcloth.engine.building import EngineUnavailable, compiler

from .cases import Case

COPY_BYTES = 128 * 2**20  # larger than any cache
FMA_SOURCE = r"""
#include <thread>
#include <vector>
static volatile float sink;
static void work(long measurement_rounds) {
    constexpr int WIDTH = 16, CHAINS = 12;  // floats of the widest SIMD register; enough chains to hide the latency
    float a[CHAINS][WIDTH];
    for (auto& row : a) for (int i = 0; i < WIDTH; ++i) row[i] = 1.0f + 1e-3f * i;
    const float x = 0.999999f, y = 1e-6f;
    for (long r = 0; r < measurement_rounds; ++r)
        for (int c = 0; c < CHAINS; ++c)
            for (int i = 0; i < WIDTH; ++i) a[c][i] = a[c][i] * x + y;
    float sum = 0;
    for (auto& row : a) for (int i = 0; i < WIDTH; ++i) sum += row[i];
    sink = sum;
}
extern "C" double flops(long measurement_rounds) { return 2.0 * 16 * 12 * measurement_rounds; }
extern "C" void run(long measurement_rounds, int threads) {
    std::vector<std::thread> others;
    for (int t = 1; t < threads; ++t) others.emplace_back(work, measurement_rounds);
    work(measurement_rounds);
    for (auto& t : others) t.join();
}
"""


class OperationCounts(NamedTuple):
    """Operations of one substep.

    Attributes:
        flops: additions and multiplications; a square root or division counts as one.
        bytes: memory that must be read or written at least once, in float32.
    """

    flops: float
    bytes: float


class Limits(NamedTuple):
    """Limits of this machine with a number of threads.

    Attributes:
        bytes_per_second: of a copy, read and written.
        flops_per_second: multiply-adds, each counted as two.
        flops_by: how the latter was measured.
    """

    bytes_per_second: float
    flops_per_second: float
    flops_by: str

    def distance(self, counts: OperationCounts, seconds: float) -> dict[str, float]:
        """Return a substep's time and the shortest times that arithmetic and memory allow."""
        arithmetic, memory = counts.flops / self.flops_per_second, counts.bytes / self.bytes_per_second
        return {
            "flops": counts.flops,
            "bytes": counts.bytes,
            "arithmetic_ms": 1e3 * arithmetic,
            "memory_ms": 1e3 * memory,
            "measured_ms": 1e3 * seconds,
            "times_the_limit": seconds / max(arithmetic, memory),
        }


# Counted by hand from the equations of a substep; multiplications and additions count as one each.
MEMBRANE_FLOPS_PER_TRIANGLE = 240.0  # per triangle: edges, F, normal, J, cofactors, stress, corner forces
DIRECTOR_FLOPS_PER_TRIANGLE = 175.0  # per triangle: stress, reaction, affine gradient from the mesh, return map
SPLINE_FLOPS_PER_POINT = 45.0  # per particle: weights and slopes along the axes
# per point and node: weight 2, slope 6, mass 2, push 11, its gathering 10, moment 18, momentum 12, gradient 21
NODE_FLOPS_PER_POINT_AND_NODE = 82.0
FLOPS_PER_VERTEX = 30.0  # per vertex: weight, velocity, position, grippers


def count_operations(case: Case, active: int) -> OperationCounts:
    """Return the operations of a substep with gravity alone and ``active`` triangles on the grid, one point each.

    Bytes: state read and written once, the mesh's constants read once, the touched nodes of the grid written and read
    once for mass and push and again for momentum.
    """
    vertices, triangles = len(case.mesh.vertices), case.triangles
    flops = FLOPS_PER_VERTEX * vertices + MEMBRANE_FLOPS_PER_TRIANGLE * triangles
    flops += (DIRECTOR_FLOPS_PER_TRIANGLE + SPLINE_FLOPS_PER_POINT + 27 * NODE_FLOPS_PER_POINT_AND_NODE) * active
    nodes = 3.0 * active  # a sheet with one point per half cell, in a layer three nodes thick: about two to four
    numbers = vertices * (2 * 6 + 1) + triangles * (3 + 4 + 1) + active * (2 * 3 + 1) + nodes * 2 * (4 + 3)
    return OperationCounts(flops, 4.0 * numbers)


def measure(threads: int) -> Limits:
    """Measure the copy bandwidth and the multiply-add rate."""
    flops = _by_compiler(threads)
    rate, how = (flops, "FMA_SOURCE loop in C++") if flops else (_by_matmul(), "float32 matmul of torch")
    return Limits(_bandwidth(), rate, how)


def _bandwidth() -> float:
    source = torch.ones(COPY_BYTES // 4)
    target = torch.empty_like(source)
    target.copy_(source)
    return 2 * COPY_BYTES / min(_seconds(lambda: target.copy_(source)) for _ in range(5))


def _by_matmul() -> float:
    a = torch.ones(1024, 1024)
    torch.mm(a, a)
    return 2 * 1024**3 / min(_seconds(lambda: torch.mm(a, a)) for _ in range(10))


def _by_compiler(threads: int) -> float | None:
    """Multiply-adds per second of a compiled loop; None without a compiler that works."""
    try:
        command = compiler()
    except EngineUnavailable:
        return None
    with tempfile.TemporaryDirectory() as folder:
        source, library = Path(folder) / "fma.cpp", Path(folder) / "fma.so"
        source.write_text(FMA_SOURCE)
        flags = ["-O3", "-march=native", "-ffast-math", "-mprefer-vector-width=512", "-shared", "-fPIC", "-pthread"]
        for chosen in (flags, [f for f in flags if not f.startswith("-mprefer")]):
            built = subprocess.run([*command, *chosen, str(source), "-o", str(library)], capture_output=True)
            if not built.returncode:
                break
        else:
            return None
        loop = ctypes.CDLL(str(library))
        loop.flops.restype = ctypes.c_double
        measurement_rounds = 500_000
        arguments = (ctypes.c_long(measurement_rounds), ctypes.c_int(threads))
        seconds = min(_seconds(lambda: loop.run(*arguments)) for _ in range(3))
        return threads * float(loop.flops(ctypes.c_long(measurement_rounds))) / seconds


def _seconds(call) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def machine(threads: int) -> dict[str, Any]:
    """Return what timings depend on: processor, threads, load and software."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "threads": threads,
        "load_before": round(os.getloadavg()[0], 2),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()
