"""What this machine can do at most, and how far a substep is from it."""

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

from torchcloth.engine.building import Unbuilt, compiler

from .cases import Case

COPIED = 128 * 2**20  # bytes: beyond any cache
FMA = r"""
#include <thread>
#include <vector>
static volatile float sink;
static void work(long rounds) {
    constexpr int WIDTH = 16, CHAINS = 12;  // floats of the widest SIMD register; enough chains to hide the latency
    float a[CHAINS][WIDTH];
    for (auto& row : a) for (int i = 0; i < WIDTH; ++i) row[i] = 1.0f + 1e-3f * i;
    const float x = 0.999999f, y = 1e-6f;
    for (long r = 0; r < rounds; ++r)
        for (int c = 0; c < CHAINS; ++c)
            for (int i = 0; i < WIDTH; ++i) a[c][i] = a[c][i] * x + y;
    float sum = 0;
    for (auto& row : a) for (int i = 0; i < WIDTH; ++i) sum += row[i];
    sink = sum;
}
extern "C" double flops(long rounds) { return 2.0 * 16 * 12 * rounds; }
extern "C" void run(long rounds, int threads) {
    std::vector<std::thread> others;
    for (int t = 1; t < threads; ++t) others.emplace_back(work, rounds);
    work(rounds);
    for (auto& t : others) t.join();
}
"""


class Counts(NamedTuple):
    """Of one substep."""

    flops: float  # additions and multiplications; a square root or division counts as one
    bytes: float  # that must be read or written at least once, float32


class Limits(NamedTuple):
    """Of this machine, with the threads asked for."""

    bytes_per_second: float  # copied: read and written
    flops_per_second: float
    flops_by: str  # how that was measured

    def distance(self, counts: Counts, seconds: float) -> dict[str, float]:
        """A substep's time against the least that arithmetic or memory would allow."""
        arithmetic, memory = counts.flops / self.flops_per_second, counts.bytes / self.bytes_per_second
        return {
            "flops": counts.flops,
            "bytes": counts.bytes,
            "arithmetic_ms": 1e3 * arithmetic,
            "memory_ms": 1e3 * memory,
            "measured_ms": 1e3 * seconds,
            "times_the_limit": seconds / max(arithmetic, memory),
        }


# By hand from physics of the substep, multiplications and additions each counted as one.
_MEMBRANE = 240.0  # per triangle: edges, F, normal, J, cofactors, stress, corner forces
_DIRECTOR = 175.0  # per triangle: stress, reaction, affine gradient from the mesh, return map
_SPLINES = 45.0  # per particle: weights and slopes along the axes
# per point and node: weight 2, slope 6, mass 2, push 11, its gathering 10, moment 18, momentum 12, gradient 21
_PER_NODE = 82.0
_VERTEX = 30.0  # per vertex: weight, velocity, position, grippers


def counts(case: Case, active: int) -> Counts:
    """Of a substep of a case with effects no more than weight, ``active`` triangles using the grid, a point each.

    Bytes: state read and written once, the mesh's constants read once, the touched nodes of the grid written and read
    once for mass and push and again for momentum.
    """
    vertices, triangles = len(case.mesh.vertices), case.triangles
    flops = _VERTEX * vertices + _MEMBRANE * triangles + (_DIRECTOR + _SPLINES + 27 * _PER_NODE) * active
    nodes = 3.0 * active  # a sheet with one point per half cell, in a layer three nodes thick: about two to four
    numbers = vertices * (2 * 6 + 1) + triangles * (3 + 4 + 1) + active * (2 * 3 + 1) + nodes * 2 * (4 + 3)
    return Counts(flops, 4.0 * numbers)


def measure(threads: int) -> Limits:
    """Copy bandwidth and multiply-add rate."""
    flops = _by_compiler(threads)
    rate, how = (flops, "FMA loop in C++") if flops else (_by_matmul(), "float32 matmul of torch")
    return Limits(_bandwidth(), rate, how)


def _bandwidth() -> float:
    source = torch.ones(COPIED // 4)
    target = torch.empty_like(source)
    target.copy_(source)
    return 2 * COPIED / min(_seconds(lambda: target.copy_(source)) for _ in range(5))


def _by_matmul() -> float:
    a = torch.ones(1024, 1024)
    torch.mm(a, a)
    return 2 * 1024**3 / min(_seconds(lambda: torch.mm(a, a)) for _ in range(10))


def _by_compiler(threads: int) -> float | None:
    """None without a compiler that works."""
    try:
        command = compiler()
    except Unbuilt:
        return None
    with tempfile.TemporaryDirectory() as folder:
        source, library = Path(folder) / "fma.cpp", Path(folder) / "fma.so"
        source.write_text(FMA)
        flags = ["-O3", "-march=native", "-ffast-math", "-mprefer-vector-width=512", "-shared", "-fPIC", "-pthread"]
        for chosen in (flags, [f for f in flags if not f.startswith("-mprefer")]):
            built = subprocess.run([*command, *chosen, str(source), "-o", str(library)], capture_output=True)
            if not built.returncode:
                break
        else:
            return None
        loop = ctypes.CDLL(str(library))
        loop.flops.restype = ctypes.c_double
        rounds = 500_000
        arguments = (ctypes.c_long(rounds), ctypes.c_int(threads))
        seconds = min(_seconds(lambda: loop.run(*arguments)) for _ in range(3))
        return threads * float(loop.flops(ctypes.c_long(rounds))) / seconds


def _seconds(call) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def machine(threads: int) -> dict[str, Any]:
    """What figures depend on."""
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
