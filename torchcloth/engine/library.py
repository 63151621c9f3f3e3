"""The engine's shared library: looked for, built where it is missing, and loaded.

A library that came with the package (``pip install`` builds it where there is a compiler) is used if it suits this
processor. Otherwise the library is built once into the cache: ``$TORCHCLOTH_CACHE``, or ``~/.cache/torchcloth``, or a
temporary folder where those cannot be written to. Without a compiler the portable library of a wheel is used, if there
is one.
"""

from __future__ import annotations

import ctypes
from contextlib import suppress
from functools import cache
from pathlib import Path

from . import building
from .building import EngineUnavailable
from .enums import check_shared_enums

PACKAGED = Path(__file__).parent / "built"


class Port(ctypes.Structure):
    """``tc::Port`` of ``csrc/run.h``: memory of the caller for one field."""

    _fields_ = [
        ("value", ctypes.c_void_p),
        ("stride", ctypes.c_int64),
        ("result", ctypes.c_void_p),
        ("seed", ctypes.c_void_p),
        ("gradient", ctypes.c_void_p),
        ("tangent", ctypes.c_void_p),
        ("tangent_stride", ctypes.c_int64),
        ("result_tangent", ctypes.c_void_p),
    ]


class RunCall(ctypes.Structure):
    """``tc::RunCall`` of ``csrc/run.h``: arguments of one run of a program."""

    _fields_ = [
        ("ports", ctypes.POINTER(Port)),
        ("scenes", ctypes.c_int64),
        ("substeps", ctypes.c_int64),
        ("directions", ctypes.c_int64),
        ("threads", ctypes.c_int64),
        ("records", ctypes.c_void_p),
        ("record_interval", ctypes.c_int64),
        ("min_ops_per_thread", ctypes.c_double),
        ("frame_ends", ctypes.POINTER(ctypes.c_int64)),
        ("frames", ctypes.c_int64),
        ("min_filled_lanes", ctypes.c_double),
    ]


def library() -> ctypes.CDLL:
    """Return the loaded library, and build it first if it is missing.

    Raises:
        EngineUnavailable: no compiler, or it failed.
    """
    result = _load_once()
    if isinstance(result, EngineUnavailable):
        raise EngineUnavailable(str(result), result.remedy)
    return result


def library_if_built() -> ctypes.CDLL | None:
    """Return the library if it was built before, else None; build nothing."""
    if not _load_once.cache_info().currsize and not _is_built():
        return None
    result = _load_once()
    return None if isinstance(result, EngineUnavailable) else result


@cache
def kernels() -> dict[str, tuple[int, int, int]]:
    """Return (number, inputs, outputs) of every kernel by its name.

    Raises:
        RuntimeError: two kernels have one name.
    """
    lib = library()
    names = [lib.tc_kernel_name(k).decode() for k in range(lib.tc_kernels())]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise RuntimeError(f"kernels of one name in csrc/kernels: {twice}")
    return {name: (k, lib.tc_kernel_info(k, 0), lib.tc_kernel_info(k, 1)) for k, name in enumerate(names)}


def status() -> str:
    """Return a line that says whether the library is built, or can be; build nothing."""
    if (file := _existing_file()) is not None:
        return f"{'portable' if file == building.find_portable(PACKAGED) else 'built'}: {file}"
    try:
        return f"will be built at first use, with {building.version(building.compiler())}"
    except EngineUnavailable as reason:
        return f"not available, the torch reference serves: {reason}; {reason.remedy}"


def _existing_file() -> Path | None:
    packaged = PACKAGED / building.file_name()
    if (file := packaged if packaged.exists() else building.cached()) is not None:
        return file
    try:
        building.compiler()  # it builds a faster library
    except EngineUnavailable:
        return building.find_portable(PACKAGED)
    return None


@cache
def _is_built() -> bool:
    """Whether the library was built when the process first asked."""
    return _existing_file() is not None


@cache
def _load_once() -> ctypes.CDLL | EngineUnavailable:
    """Load once per process, also where it failed."""
    with suppress(OSError):  # there is none for this processor, or its C++ runtime is missing
        return _load(PACKAGED / building.file_name())
    try:
        return _load(building.cached() or building.build())
    except EngineUnavailable as reason:
        with suppress(OSError):
            if (portable := building.find_portable(PACKAGED)) is not None:
                return _load(portable)
        return reason
    except OSError as error:
        remedy = "delete it, or set TORCHCLOTH_CACHE elsewhere"
        return EngineUnavailable(f"the engine's library does not load: {error}", remedy)


def _load(file: Path) -> ctypes.CDLL:
    lib = ctypes.CDLL(str(file))
    for suffix in "fd":
        _declare(lib, suffix)
    for name in ("error", "kernel_name", "enums"):
        getattr(lib, f"tc_{name}").restype = ctypes.c_char_p
    check_shared_enums(lib.tc_enums().decode())
    return lib


def _declare(lib: ctypes.CDLL, suffix: str) -> None:
    pointer, number = ctypes.c_void_p, ctypes.c_int
    signatures = {
        "new": (pointer, []),
        "free": (None, [pointer]),
        "field": (number, [pointer] + [number] * 5 + [pointer]),
        "next_state": (number, [pointer, number, number]),
        "table": (number, [pointer, pointer, number]),
        "loop": (number, [pointer] + [number] * 5),
        "move": (number, [pointer, number, number, number, number]),
        "kernel": (number, [pointer, number, pointer, pointer, number]),
        "lookup": (number, [pointer] + [number] * 6),
        "broad_phase": (number, [pointer] + [number] * 7 + [ctypes.c_double]),
        "grid_velocity": (number, [pointer] + [number] * 3 + [ctypes.c_double]),
        "stencil": (number, [pointer] + [number] * 5),
        "transfer": (number, [pointer] + [number] * 7),
        "contact_search": (number, [pointer, pointer, number, pointer, number, pointer, number] + [pointer] * 6),
        "lay_out": (number, [pointer]),
        "record_size": (ctypes.c_int64, [pointer, number]),
        "records_size": (ctypes.c_int64, [pointer, ctypes.c_int64, ctypes.c_int64]),
        "run": (number, [pointer, ctypes.POINTER(RunCall), number]),
        "nearest": (number, [pointer, ctypes.c_int64, pointer, ctypes.c_int64, pointer, pointer]),
    }
    for name, (result, arguments) in signatures.items():
        function = getattr(lib, f"tc_{name}_{suffix}")
        function.restype, function.argtypes = result, arguments
