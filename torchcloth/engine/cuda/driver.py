"""NVIDIA's run-time compiler (NVRTC) and driver, by their C interfaces: both come with torch and the device."""

from __future__ import annotations

import ctypes
import hashlib
import sysconfig
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path

import torch

from .. import building
from ..building import EngineUnavailable

NVRTC_FLAGS = ("--std=c++17", "--fmad=true", "--extra-device-vectorization")
OUT_OF_MEMORY_CODE = 2
UNUSABLE_MODULE_CODES = (200, 209, 218, 222, 300)  # machine code that is damaged, or for another device or driver
MAX_LOG_CHARACTERS = 2000


def _options(threads: int, device: torch.device) -> tuple[str, ...]:
    major, minor = torch.cuda.get_device_capability(device)
    return (*NVRTC_FLAGS, f"--gpu-architecture=sm_{major}{minor}", f"-DTHREADS={threads}")


def _file_name(text: str, options: Sequence[str]) -> str:
    digest = hashlib.sha256("\0".join([text, *options, str(torch.version.cuda)]).encode()).hexdigest()[:20]
    return f"program-{digest}.cubin"


def _store(name: str, code: bytes) -> None:
    for folder in building.private_cache_folders():
        with suppress(OSError):
            building.store(folder / name, code)
            return


class DeviceKernels:
    """The kernels of a text, compiled for blocks of so many threads on a device.

    Raises:
        EngineUnavailable: the text cannot be compiled or loaded.
    """

    def __init__(self, text: str, threads: int, device: torch.device) -> None:
        self.threads, self._device = threads, device
        self._functions: dict[str, ctypes.c_void_p] = {}
        options = _options(threads, device)
        name = _file_name(text, options)
        file = building.cached(name)
        code = None if file is None else building.read_sealed(file)
        module = None if code is None else self._load(code)
        if module is None:  # there is no file, or its code does not load
            code = _compile(text, options)
            module = self._load(code)
            if module is None:
                remedy = "update NVIDIA's driver, or torch"
                raise EngineUnavailable("the driver does not load what NVRTC compiles", remedy)
            _store(name, code)
        self._module = module

    def _load(self, code: bytes) -> ctypes.c_void_p | None:
        module = ctypes.c_void_p()
        with torch.cuda.device(self._device):
            torch.cuda.current_stream().synchronize()  # makes the context
            status = _retry_when_out_of_memory(lambda: _driver().cuModuleLoadData(ctypes.byref(module), code))
            if status in UNUSABLE_MODULE_CODES:
                return None
            _check(status)
            return module

    def launch(self, name: str, blocks: int, shared: int, arguments: Sequence[ctypes._SimpleCData]) -> None:
        """Start a kernel on torch's current stream.

        Args:
            name: of the kernel.
            blocks: how many.
            shared: shared memory of each [bytes].
            arguments: pointers and counts.

        Raises:
            RuntimeError: the driver reports an error.
        """
        with torch.cuda.device(self._device):
            if name not in self._functions:
                function = ctypes.c_void_p()
                _check(_driver().cuModuleGetFunction(ctypes.byref(function), self._module, name.encode()))
                self._functions[name] = function
            pointers = (ctypes.c_void_p * len(arguments))(*(ctypes.addressof(a) for a in arguments))
            stream = ctypes.c_void_p(torch.cuda.current_stream().cuda_stream)
            sizes = tuple(ctypes.c_uint(n) for n in (blocks, 1, 1, self.threads, 1, 1, shared))
            launch_arguments = (self._functions[name], *sizes, stream, pointers, None)
            _check(_retry_when_out_of_memory(lambda: _driver().cuLaunchKernel(*launch_arguments)))


def _compile(text: str, options: Sequence[str]) -> bytes:
    nvrtc = _compiler()
    program = ctypes.c_void_p()
    flags = (ctypes.c_char_p * len(options))(*(o.encode() for o in options))
    status = nvrtc.nvrtcCreateProgram(ctypes.byref(program), text.encode(), b"program.cu", 0, None, None)
    if status:
        raise EngineUnavailable(f"NVRTC: error {status}", "reinstall torch with CUDA")
    try:
        status, size = nvrtc.nvrtcCompileProgram(program, len(options), flags), ctypes.c_size_t()
        if status:
            nvrtc.nvrtcGetProgramLogSize(program, ctypes.byref(size))
            log = ctypes.create_string_buffer(size.value)
            nvrtc.nvrtcGetProgramLog(program, log)
            message = log.value.decode()[:MAX_LOG_CHARACTERS]
            raise EngineUnavailable(f"NVRTC: {message}", "report it, with torch's version and the device")
        nvrtc.nvrtcGetCUBINSize(program, ctypes.byref(size))
        code = ctypes.create_string_buffer(size.value)
        nvrtc.nvrtcGetCUBIN(program, code)
        return code.raw
    finally:
        nvrtc.nvrtcDestroyProgram(ctypes.byref(program))


def status() -> str:
    """Return a line that says whether programs can be compiled for a device; compile nothing."""
    try:
        _compiler()
        _driver()
    except EngineUnavailable as reason:
        return f"not available, graphs of the torch reference serve: {reason}; {reason.remedy}"
    return "programs are compiled at first use"


@cache
def _compiler() -> ctypes.CDLL:
    """torch's own NVRTC."""
    for name in _library_names():
        with suppress(OSError):
            return ctypes.CDLL(name)
    raise EngineUnavailable("no libnvrtc", "install torch with CUDA, or CUDA's toolkit")


def _library_names() -> Iterator[str]:
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
        raise EngineUnavailable(f"no CUDA driver: {error}", "install NVIDIA's driver") from error


def _retry_when_out_of_memory(call: Callable[[], int]) -> int:
    """The driver's status; where memory is short, that of a second try with what torch can spare."""
    code = call()
    if code != OUT_OF_MEMORY_CODE:
        return code
    torch.cuda.empty_cache()
    return call()


def _check(code: int) -> None:
    if code:
        text = ctypes.c_char_p()
        _driver().cuGetErrorString(code, ctypes.byref(text))
        raise RuntimeError(f"CUDA: {(text.value or b'error').decode()} ({code})")
