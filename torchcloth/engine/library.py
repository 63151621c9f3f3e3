"""The engine's shared library: found, built when it is not there, and loaded."""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
import tempfile
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

SOURCES = Path(__file__).parent / "csrc"
FLAGS = "-std=c++20 -O3 -march=native -fPIC -fno-math-errno -fno-trapping-math -fno-signed-zeros -fvisibility=hidden"
QUIET = "-Wno-psabi"


class Port(ctypes.Structure):
    """``tc::Port`` of csrc/run.h."""

    _fields_ = [
        ("value", ctypes.c_void_p),
        ("stride", ctypes.c_int64),
        ("result", ctypes.c_void_p),
        ("seed", ctypes.c_void_p),
        ("gradient", ctypes.c_void_p),
        ("dot", ctypes.c_void_p),
        ("dot_stride", ctypes.c_int64),
        ("dot_result", ctypes.c_void_p),
    ]


class Call(ctypes.Structure):
    """``tc::Call`` of csrc/run.h."""

    _fields_ = [
        ("ports", ctypes.POINTER(Port)),
        ("scenes", ctypes.c_int64),
        ("substeps", ctypes.c_int64),
        ("directions", ctypes.c_int64),
        ("threads", ctypes.c_int64),
        ("records", ctypes.c_void_p),
        ("every", ctypes.c_int64),
    ]


@cache
def library() -> ctypes.CDLL:
    """The loaded library, built if need be.

    Raises:
        RuntimeError: no compiler, or it failed.
    """
    lib = ctypes.CDLL(str(_built()))
    for letter in "fd":
        _declare(lib, letter)
    lib.tc_error.restype = ctypes.c_char_p
    lib.tc_kernel_name.restype = ctypes.c_char_p
    return lib


@cache
def kernels() -> dict[str, tuple[int, int, int]]:
    """By name: (number, inputs, outputs)."""
    lib = library()
    found = range(lib.tc_kernels())
    return {lib.tc_kernel_name(k).decode(): (k, lib.tc_kernel_info(k, 0), lib.tc_kernel_info(k, 1)) for k in found}


def _declare(lib: ctypes.CDLL, letter: str) -> None:
    pointer, number = ctypes.c_void_p, ctypes.c_int
    signatures = {
        "new": (pointer, []),
        "free": (None, [pointer]),
        "field": (number, [pointer] + [number] * 5 + [pointer]),
        "pair": (None, [pointer, number, number]),
        "table": (number, [pointer, pointer, number]),
        "loop": (None, [pointer] + [number] * 5),
        "move": (number, [pointer, number, number, number, number]),
        "call": (number, [pointer, number, pointer, pointer, number]),
        "lookup": (number, [pointer] + [number] * 6),
        "sieve": (None, [pointer] + [number] * 7 + [ctypes.c_double]),
        "stencil": (None, [pointer] + [number] * 5),
        "transfer": (number, [pointer] + [number] * 7),
        "contact": (None, [pointer, pointer, number, pointer, number, pointer, number] + [pointer] * 6),
        "ready": (None, [pointer]),
        "size": (ctypes.c_int64, [pointer, number]),
        "records": (ctypes.c_int64, [pointer, ctypes.c_int64, ctypes.c_int64]),
        "run": (number, [pointer, ctypes.POINTER(Call), number]),
    }
    for name, (result, arguments) in signatures.items():
        function = getattr(lib, f"tc_{name}_{letter}")
        function.restype, function.argtypes = result, arguments


def _built() -> Path:
    files = sorted(p for p in SOURCES.rglob("*") if p.suffix in (".h", ".cpp"))
    key = hashlib.sha256(b"".join(p.read_bytes() for p in files) + FLAGS.encode()).hexdigest()[:16]
    folder = Path(os.environ.get("TORCHCLOTH_CACHE", Path.home() / ".cache" / "torchcloth"))
    target = folder / f"engine-{key}.so"
    if not target.exists():
        folder.mkdir(parents=True, exist_ok=True)
        _build([p for p in files if p.suffix == ".cpp"], target)
    return target


def _build(sources: list[Path], target: Path) -> None:
    compiler = shutil.which(os.environ.get("CXX", "g++")) or shutil.which("clang++")
    if compiler is None:
        raise RuntimeError("no C++ compiler")
    with tempfile.TemporaryDirectory(dir=target.parent) as scratch:
        objects = [Path(scratch) / f"{number}.o" for number in range(len(sources))]

        def compile(pair: tuple[Path, Path]) -> None:
            _run([compiler, *FLAGS.split(), QUIET, "-c", str(pair[0]), "-o", str(pair[1])])

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(compile, zip(sources, objects, strict=True)))
        made = Path(scratch) / "engine.so"
        _run([compiler, "-shared", *map(str, objects), "-o", str(made), "-pthread"])
        os.replace(made, target)


def _run(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command[:1])} failed: {done.stderr[-2000:]}")
