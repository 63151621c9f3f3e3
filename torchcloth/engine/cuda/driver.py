"""NVIDIA's run-time compiler and driver, by their C interfaces: both come with torch and the device."""

from __future__ import annotations

import ctypes
import hashlib
import sysconfig
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path

import torch

from ..._utils.files import atomically
from .. import building
from ..building import Unbuilt

FLAGS = ("--std=c++17", "--fmad=true", "--extra-device-vectorization")
OUT_OF_MEMORY = 2
UNFIT = (200, 209, 218, 222, 300)  # machine code that is damaged, or for another device or driver
LOG = 2000  # characters of what the compiler says


def _options(threads: int, device: torch.device) -> tuple[str, ...]:
    major, minor = torch.cuda.get_device_capability(device)
    return (*FLAGS, f"--gpu-architecture=sm_{major}{minor}", f"-DTHREADS={threads}")


def _name(text: str, options: Sequence[str]) -> str:
    """Of a file with the machine code."""
    known = hashlib.sha256("\0".join([text, *options, str(torch.version.cuda)]).encode()).hexdigest()[:20]
    return f"program-{known}.cubin"


def _keep(name: str, code: bytes) -> None:
    for folder in building.own_folders():
        with suppress(OSError), atomically(folder / name) as file:
            file.write_bytes(code)
            return


class Kernels:
    """A text, compiled for blocks of so many threads on a device.

    Raises:
        Unbuilt: it cannot be.
    """

    def __init__(self, text: str, threads: int, device: torch.device) -> None:
        self.threads, self._device = threads, device
        self._functions: dict[str, ctypes.c_void_p] = {}
        options = _options(threads, device)
        name = _name(text, options)
        module, known = None, building.cached(name)
        with suppress(OSError):
            module = None if known is None else self._loaded(known.read_bytes())
        if module is None:  # nothing is there, or what does not load
            code = _compile(text, options)
            module = self._loaded(code)
            if module is None:
                raise Unbuilt("the driver does not load what NVRTC compiles", "update NVIDIA's driver, or torch")
            _keep(name, code)
        self._module = module

    def _loaded(self, code: bytes) -> ctypes.c_void_p | None:
        module = ctypes.c_void_p()
        with torch.cuda.device(self._device):
            torch.cuda.current_stream().synchronize()  # then there is a context
            answer = _again(lambda: _driver().cuModuleLoadData(ctypes.byref(module), code))
            if answer in UNFIT:
                return None
            _check(answer)
            return module

    def launch(self, name: str, blocks: int, shared: int, arguments: Sequence[ctypes._SimpleCData]) -> None:
        """Start a kernel on torch's current stream.

        Args:
            name: of the kernel.
            blocks: how many.
            shared: bytes of each.
            arguments: pointers and counts.
        """
        with torch.cuda.device(self._device):
            if name not in self._functions:
                function = ctypes.c_void_p()
                _check(_driver().cuModuleGetFunction(ctypes.byref(function), self._module, name.encode()))
                self._functions[name] = function
            pointers = (ctypes.c_void_p * len(arguments))(*(ctypes.addressof(a) for a in arguments))
            stream = ctypes.c_void_p(torch.cuda.current_stream().cuda_stream)
            sizes = tuple(ctypes.c_uint(n) for n in (blocks, 1, 1, self.threads, 1, 1, shared))
            given = (self._functions[name], *sizes, stream, pointers, None)
            _check(_again(lambda: _driver().cuLaunchKernel(*given)))


def _compile(text: str, options: Sequence[str]) -> bytes:
    nvrtc = _compiler()
    program = ctypes.c_void_p()
    given = (ctypes.c_char_p * len(options))(*(o.encode() for o in options))
    made = nvrtc.nvrtcCreateProgram(ctypes.byref(program), text.encode(), b"program.cu", 0, None, None)
    if made:
        raise Unbuilt(f"NVRTC: error {made}", "reinstall torch with CUDA")
    try:
        failed, size = nvrtc.nvrtcCompileProgram(program, len(options), given), ctypes.c_size_t()
        if failed:
            nvrtc.nvrtcGetProgramLogSize(program, ctypes.byref(size))
            log = ctypes.create_string_buffer(size.value)
            nvrtc.nvrtcGetProgramLog(program, log)
            raise Unbuilt(f"NVRTC: {log.value.decode()[:LOG]}", "report it, with torch's version and the device")
        nvrtc.nvrtcGetCUBINSize(program, ctypes.byref(size))
        code = ctypes.create_string_buffer(size.value)
        nvrtc.nvrtcGetCUBIN(program, code)
        return code.raw
    finally:
        nvrtc.nvrtcDestroyProgram(ctypes.byref(program))


def status() -> str:
    """Whether programs can be compiled for a device, in a line; compiles nothing."""
    try:
        _compiler()
        _driver()
    except Unbuilt as miss:
        return f"not available, graphs of the torch reference serve: {miss}; {miss.remedy}"
    return "programs are compiled at first use"


@cache
def _compiler() -> ctypes.CDLL:
    """torch's own NVRTC.

    Raises:
        Unbuilt: it is not there.
    """
    for name in _names():
        with suppress(OSError):
            return ctypes.CDLL(name)
    raise Unbuilt("no libnvrtc", "install torch with CUDA, or CUDA's toolkit")


def _names() -> Iterator[str]:
    major = (torch.version.cuda or "").partition(".")[0]
    yield f"libnvrtc.so.{major}"  # torch may have loaded it
    for folder in (sysconfig.get_path("purelib"), Path(torch.__file__).parent.parent):
        yield from map(str, sorted(Path(folder).glob(f"nvidia/*/lib/libnvrtc.so.{major}*")))
    yield "libnvrtc.so"


@cache
def _driver() -> ctypes.CDLL:
    try:
        return ctypes.CDLL("libcuda.so.1")
    except OSError as error:
        raise Unbuilt(f"no CUDA driver: {error}", "install NVIDIA's driver") from error


def _again(call: Callable[[], int]) -> int:
    """The driver's answer; where memory is short, once more with what torch can spare."""
    code = call()
    if code != OUT_OF_MEMORY:
        return code
    torch.cuda.empty_cache()
    return call()


def _check(code: int) -> None:
    if code:
        text = ctypes.c_char_p()
        _driver().cuGetErrorString(code, ctypes.byref(text))
        raise RuntimeError(f"CUDA: {(text.value or b'error').decode()} ({code})")
