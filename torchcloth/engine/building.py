"""Building the engine's library, with nothing but Python's own modules: ``setup.py`` runs this file by itself.

A library is named by its sources and by the processor and flags it was built for, so a wrong one is never taken. Wheels
hold portable libraries as well: one for each instruction set level of ``PORTABLE_LEVELS``, named by level and sources.
They serve where there is no library for the very processor and no compiler.

A file of the cache is code that runs with the user's rights. It is taken only where nobody else could have written or
exchanged it, and only whole: it ends with its own digest.
"""

from __future__ import annotations

import hashlib
import os
import platform
import shlex
import shutil
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

SOURCES = Path(__file__).parent / "csrc"
FLAGS = (
    "-std=c++20 -O3 -march=native -fPIC -fno-strict-aliasing -fno-math-errno -fno-trapping-math -fno-signed-zeros "
    "-fvisibility=hidden -Wno-psabi -pthread"
)
NATIVE_FLAG = "-march=native"
EXTRA_FLAGS_VARIABLE = "TORCHCLOTH_ENGINE_FLAGS"  # such as those of sanitizers; a library is named by them, too
# What /proc/cpuinfo lists for the instruction set levels of the x86-64 psABI.
X86_64_V2_FEATURES = frozenset({"cx16", "lahf_lm", "popcnt", "pni", "sse4_1", "sse4_2", "ssse3"})
X86_64_V3_FEATURES = X86_64_V2_FEATURES | {"abm", "avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "movbe", "xsave"}
X86_64_V4_FEATURES = X86_64_V3_FEATURES | {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}
# Levels of portable libraries by machine, best first, and the features that each needs. On a processor with AVX-512 v4
# is as fast as a native library; v3 takes 1.5 times as long. v2 takes 1.3 times as long as v3 in float64.
PORTABLE_LEVELS = {
    "x86_64": {"x86-64-v4": X86_64_V4_FEATURES, "x86-64-v3": X86_64_V3_FEATURES},
    "aarch64": {"armv8-a": frozenset()},
    "arm64": {"armv8-a": frozenset()},
}
CLANG_FLAGS = "-fbracket-depth=16384 -fconstexpr-steps=200000000"  # its limits are lower than a kernel's trace
DIGEST_MARK = b"torchcloth-sha256:"  # before the digest at the end of a file; the loader of libraries allows a tail
KERNEL_BYTES_PER_CORE_SECOND = 420.0  # source that one core compiles in a second, measured with g++ 12


class EngineUnavailable(RuntimeError):
    """The engine's library cannot be had; the text says why.

    Attributes:
        remedy: what the user can do about it.
    """

    def __init__(self, reason: str, remedy: str) -> None:
        super().__init__(reason)
        self.remedy = remedy


def file_name() -> str:
    """Return the name of the library for these sources on this processor."""
    return f"engine-{_digest(' '.join([FLAGS, platform.machine(), _processor(), *_extra_flags()]))}.so"


def portable_file_name(level: str) -> str:
    """Return the name of the portable library for these sources, e.g. ``engine-x86-64-v3-0123456789abcdef0123.so``."""
    return f"engine-{level}-{_digest(FLAGS)}.so"


def _extra_flags() -> list[str]:
    """Flags of the environment, separated by spaces, which a native library is built with."""
    return os.environ.get(EXTRA_FLAGS_VARIABLE, "").split()


def _digest(target: str) -> str:
    digest = hashlib.sha256(target.encode())
    for file in _sources():
        digest.update(file.relative_to(SOURCES).as_posix().encode() + file.read_bytes())
    return digest.hexdigest()[:20]


def portable_levels() -> dict[str, frozenset[str]]:
    """Return the instruction set levels of portable libraries for this kind of machine, best first."""
    return PORTABLE_LEVELS.get(platform.machine(), {})


def find_portable(folder: Path) -> Path | None:
    """Return the best portable library in ``folder`` that this processor can run, or None."""
    features = set(_processor().split())
    usable = [level for level, needed in portable_levels().items() if needed <= features]
    files = (folder / portable_file_name(level) for level in usable)
    return next((file for file in files if file.is_file()), None)


def compiler() -> list[str]:
    """Return the compiler's command: $CXX, g++ or clang++.

    Raises:
        EngineUnavailable: there is no compiler.
    """
    for command in (os.environ.get("CXX", ""), "g++", "clang++", "c++"):
        try:
            parts = shlex.split(command)
        except ValueError as error:
            raise EngineUnavailable(f"CXX is no command ({error})", "correct it, or leave it out") from None
        if parts and shutil.which(parts[0]):
            return parts
    raise EngineUnavailable("no C++ compiler", "install one (Debian, Ubuntu: apt-get install g++) or name it in CXX")


def version(command: list[str]) -> str:
    """Return the first line of the compiler's version."""
    with suppress(OSError):
        process = subprocess.run([*command, "--version"], capture_output=True, text=True)
        return (process.stdout or process.stderr).partition("\n")[0]
    return command[0]


def cache_folders() -> list[Path]:
    """Return the folders in which a library may lie, best first."""
    chosen = os.environ.get("TORCHCLOTH_CACHE")
    folders = [Path(chosen).expanduser().resolve()] if chosen else []  # the loader would search for a bare name
    with suppress(RuntimeError):  # the user has no home
        folders.append(Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "torchcloth")
    return [*folders, Path(tempfile.gettempdir()) / f"torchcloth-{os.getuid() if hasattr(os, 'getuid') else 'cache'}"]


def cached(name: str | None = None) -> Path | None:
    """Return a file in the cache, by default the library; None if it is not there, whole, and safe to load."""
    name = file_name() if name is None else name
    files = (loadable_file(folder / name) for folder in cache_folders())
    return next((file for file in files if file is not None), None)


def loadable_file(path: Path) -> Path | None:
    """Return the real path of a file of the cache; None if it is not there, whole, and safe to load."""
    file = trusted_path(path)
    return None if file is None or read_sealed(file) is None else file


def trusted_path(path: Path) -> Path | None:
    """Return the real path of a file or folder that only this user or root could have made or exchanged; else None.

    Every folder on the real path, from the root on, is checked in this order: it belongs to this user or to root, and
    nobody else may write there, or only what is theirs (sticky). Then nobody else can exchange what was checked.
    """
    if not hasattr(os, "getuid"):
        return path if path.exists() else None
    try:
        if path.is_symlink():
            return None
        real = path.resolve(strict=True)
        for part in (*reversed(real.parents), real):
            if not _is_private(part.lstat(), is_last=part == real):
                return None
    except (OSError, RuntimeError):  # not there, not to be seen, or a circle of links
        return None
    return real


def _is_private(status: os.stat_result, is_last: bool) -> bool:
    """Whether only root and this user can change an entry; a sticky folder on the way may be everybody's."""
    others_may_write = bool(status.st_mode & stat.S_IWOTH)
    # a private group of the user's has the user's number
    group_may_write = bool(status.st_mode & stat.S_IWGRP) and status.st_gid not in (0, os.getuid())
    is_sticky_folder = stat.S_ISDIR(status.st_mode) and bool(status.st_mode & stat.S_ISVTX)
    is_ours = status.st_uid in (0, os.getuid()) and not stat.S_ISLNK(status.st_mode)
    return is_ours and (not (others_may_write or group_may_write) or (is_sticky_folder and not is_last))


def read_sealed(file: Path) -> bytes | None:
    """Return the content of a file of the cache without its digest; None if they disagree, as after a power cut."""
    try:
        content, mark, digest = file.read_bytes().rpartition(DIGEST_MARK)
    except OSError:
        return None
    return content if mark and digest == hashlib.sha256(content).digest() else None


def store(target: Path, content: bytes) -> None:
    """Write a sealed file into the cache, whole or not at all, for nobody else to change."""
    with tempfile.TemporaryDirectory(dir=target.parent) as scratch:
        part = Path(scratch) / target.name
        with part.open("wb") as file:
            file.write(content + DIGEST_MARK + hashlib.sha256(content).digest())
            file.flush()
            os.fsync(file.fileno())
        part.chmod(0o700)
        os.replace(part, target)


def build(level: str | None = None) -> Path:
    """Return the library in the cache, built there unless it is there.

    Args:
        level: of a portable library, one of ``portable_levels()``; None: the native library.

    Raises:
        EngineUnavailable: no compiler, it failed, or no folder can be written to.
    """
    command = compiler()
    name = file_name() if level is None else portable_file_name(level)
    flags = [*FLAGS.split(), *_extra_flags()]
    if level is not None:
        flags = FLAGS.replace(NATIVE_FLAG, f"-march={level}").split()
    for folder in private_cache_folders():
        with suppress(OSError):
            target = folder / name
            with _build_lock(folder):  # another process may be building the same
                if loadable_file(target) is None:
                    _compile(command, target, flags)
            return target
    places = ", ".join(str(f) for f in cache_folders())
    reason = f"no folder for the engine's library can be written to ({places})"
    raise EngineUnavailable(reason, "name one in TORCHCLOTH_CACHE")


def private_cache_folders() -> Iterator[Path]:
    """Yield the real paths of the cache folders that exist or can be made, and are private; best first."""
    for folder in cache_folders():
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            if (private := trusted_path(folder)) is not None:
                yield private
            else:
                print(f"torchcloth: {folder} is not used: others can write there", file=sys.stderr, flush=True)


def _sources() -> list[Path]:
    return sorted(p for p in SOURCES.rglob("*") if p.suffix in (".h", ".cpp"))


@cache
def _processor() -> str:
    """Instruction sets of the processor, on which -march=native depends."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
            name, _, value = line.partition(":")
            if name.strip() in ("flags", "Features"):
                return " ".join(sorted(value.split()))
    return platform.processor()


@contextmanager
def _build_lock(folder: Path) -> Iterator[None]:
    with open(folder / "building.lock", "w", encoding="utf-8") as lock:
        with suppress(ImportError, OSError):  # without locks two processes build twice, and the last result stays
            import fcntl

            fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def _compile(command: list[str], target: Path, flags: list[str]) -> None:
    files = [p for p in _sources() if p.suffix == ".cpp"]
    cores = min(os.cpu_count() or 1, len(files))
    seconds = sum(p.stat().st_size for p in files if p.parent.name == "kernels") / KERNEL_BYTES_PER_CORE_SECOND / cores
    print(f"torchcloth: building the engine once with {command[0]}, about {seconds:.0f} s", file=sys.stderr, flush=True)
    flags = flags + (CLANG_FLAGS.split() if "clang" in version(command) else [])
    with tempfile.TemporaryDirectory(dir=target.parent) as scratch:
        library = Path(scratch) / "engine.so"

        def compile_one(pair: tuple[int, Path]) -> str:
            out = str(Path(scratch) / f"{pair[0]}.o")
            _run([*command, *flags, "-c", str(pair[1]), "-o", out])
            return out

        with ThreadPoolExecutor(cores) as pool:
            objects = list(pool.map(compile_one, enumerate(files)))
        _run([*command, *flags, "-shared", *objects, "-o", str(library)])
        store(target, library.read_bytes())


def _run(command: list[str]) -> None:
    process = subprocess.run(command, capture_output=True, text=True)
    if process.returncode:
        lines = (process.stderr or process.stdout).splitlines()
        first = next((line.strip() for line in lines if "error" in line), lines[-1] if lines else "no message")
        raise EngineUnavailable(
            f"{command[0]} failed (exit code {process.returncode}): {first}",
            "name a compiler for C++20 in CXX (g++ 12 or clang++ 15, or later)",
        )
