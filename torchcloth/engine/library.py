"""The engine's shared library: found, built when it is not there, and loaded.

One that came with the package (``pip install`` builds it where there is a compiler) serves if it is right for this
processor; otherwise it is built once into the cache: ``$TORCHCLOTH_CACHE``, or ``~/.cache/torchcloth``, or a temporary
folder where those cannot be written to. Without a compiler the portable library of a wheel serves, if there is one.
"""

from __future__ import annotations

import ctypes
from contextlib import suppress
from functools import cache
from pathlib import Path

from . import building
from .building import Unbuilt

PACKAGED = Path(__file__).parent / "built"


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
        ("worth", ctypes.c_double),
        ("ends", ctypes.POINTER(ctypes.c_int64)),
        ("frames", ctypes.c_int64),
    ]


def library() -> ctypes.CDLL:
    """The loaded library, built if need be.

    Raises:
        Unbuilt: no compiler, or it failed.
    """
    found = _found()
    if isinstance(found, Unbuilt):
        raise Unbuilt(str(found), found.remedy)
    return found


def at_hand() -> ctypes.CDLL | None:
    """The same where it was built before; builds nothing."""
    if not _found.cache_info().currsize and not _built():
        return None
    found = _found()
    return None if isinstance(found, Unbuilt) else found


@cache
def kernels() -> dict[str, tuple[int, int, int]]:
    """By name: (number, inputs, outputs)."""
    lib = library()
    names = [lib.tc_kernel_name(k).decode() for k in range(lib.tc_kernels())]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise RuntimeError(f"kernels of one name in csrc/kernels: {twice}")
    return {name: (k, lib.tc_kernel_info(k, 0), lib.tc_kernel_info(k, 1)) for k, name in enumerate(names)}


def status() -> str:
    """Whether it is built, or can be, in a line; builds nothing."""
    if (file := _there()) is not None:
        return f"{'portable' if file == building.find_portable(PACKAGED) else 'built'}: {file}"
    try:
        return f"will be built at first use, with {building.version(building.compiler())}"
    except Unbuilt as miss:
        return f"not available, the torch reference serves: {miss}; {miss.remedy}"


def _there() -> Path | None:
    """The file, if it was built."""
    packaged = PACKAGED / building.file_name()
    if (file := packaged if packaged.exists() else building.cached()) is not None:
        return file
    try:
        building.compiler()  # that builds a faster one
    except Unbuilt:
        return building.find_portable(PACKAGED)
    return None


@cache
def _built() -> bool:
    """When a process first asks."""
    return _there() is not None


@cache
def _found() -> ctypes.CDLL | Unbuilt:
    """Once per process, also where it failed."""
    with suppress(OSError):  # none for this processor, or its C++ runtime is not here
        return _loaded(PACKAGED / building.file_name())
    try:
        return _loaded(building.cached() or building.build())
    except Unbuilt as miss:
        with suppress(OSError):
            if (portable := building.find_portable(PACKAGED)) is not None:
                return _loaded(portable)
        return miss
    except OSError as error:
        return Unbuilt(f"the engine's library does not load: {error}", "delete it, or set TORCHCLOTH_CACHE elsewhere")


def _loaded(file: Path) -> ctypes.CDLL:
    lib = ctypes.CDLL(str(file))
    for letter in "fd":
        _declare(lib, letter)
    lib.tc_error.restype = ctypes.c_char_p
    lib.tc_kernel_name.restype = ctypes.c_char_p
    return lib


def _declare(lib: ctypes.CDLL, letter: str) -> None:
    pointer, number = ctypes.c_void_p, ctypes.c_int
    signatures = {
        "new": (pointer, []),
        "free": (None, [pointer]),
        "field": (number, [pointer] + [number] * 5 + [pointer]),
        "pair": (number, [pointer, number, number]),
        "table": (number, [pointer, pointer, number]),
        "loop": (number, [pointer] + [number] * 5),
        "move": (number, [pointer, number, number, number, number]),
        "call": (number, [pointer, number, pointer, pointer, number]),
        "lookup": (number, [pointer] + [number] * 6),
        "sieve": (number, [pointer] + [number] * 7 + [ctypes.c_double]),
        "per_mass": (number, [pointer] + [number] * 3 + [ctypes.c_double]),
        "stencil": (number, [pointer] + [number] * 5),
        "transfer": (number, [pointer] + [number] * 7),
        "contact": (number, [pointer, pointer, number, pointer, number, pointer, number] + [pointer] * 6),
        "ready": (number, [pointer]),
        "size": (ctypes.c_int64, [pointer, number]),
        "records": (ctypes.c_int64, [pointer, ctypes.c_int64, ctypes.c_int64]),
        "run": (number, [pointer, ctypes.POINTER(Call), number]),
        "nearest": (number, [pointer, ctypes.c_int64, pointer, ctypes.c_int64, pointer, pointer]),
    }
    for name, (result, arguments) in signatures.items():
        function = getattr(lib, f"tc_{name}_{letter}")
        function.restype, function.argtypes = result, arguments
