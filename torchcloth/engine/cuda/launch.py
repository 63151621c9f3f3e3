"""Running a program on a device: values, and adjoints by repeating a few substeps at a time."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from functools import lru_cache
from math import isqrt
from typing import Protocol
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor

from ...errors import InvalidInput
from ..building import EngineUnavailable
from ..enums import FieldKind
from ..execution import Job
from ..fields import Field
from ..program import MAX_CACHED_PROGRAMS, Program
from .codegen import CudaModule
from .driver import DeviceKernels

STATE_BUDGET_BYTES = 256 * 2**20  # states that an adjoint keeps at a time
MAX_CHUNK_SUBSTEPS, MIN_CHUNK_SUBSTEPS = 64, 8  # of an adjoint
THREADS_PER_BLOCK = 512  # measured with 441 vertices; the count of scenes hardly matters
MAX_SHARED_BYTES = 48 * 2**10  # shared memory that every device has
POINTERS_PER_PORT = 5  # 64-bit numbers of ``Port`` in codegen.py


class Device(Protocol):
    """Compiled kernels.

    Attributes:
        threads: of a block.
    """

    threads: int

    def launch(self, name: str, blocks: int, shared: int, arguments: Sequence[ctypes._SimpleCData]) -> None:
        """Start one of them; ``shared``: bytes for each block."""
        ...


class DeviceProgram:
    """A program on one device.

    Attributes:
        module: its source and memory layout.
        passed_self_test: whether it was compared with the CPU, and agrees.
        failure: what it did wrong, and what the user can do about it; None.

    Raises:
        EngineUnavailable: a block needs more shared memory than there is.
    """

    passed_self_test = False
    failure: tuple[str, str] | None = None

    def __init__(self, module: CudaModule, kernels: Device, device: torch.device, dtype: torch.dtype) -> None:
        self.module, self.kernels = module, kernels
        self.data = torch.from_numpy(module.data).to(device, dtype)
        self.tables = torch.from_numpy(module.tables).to(device)
        warps = -(-kernels.threads // 32) if device.type == "cuda" else kernels.threads
        self._shared_bytes = module.shared * (1 + warps) * dtype.itemsize
        if self._shared_bytes > MAX_SHARED_BYTES:
            raise EngineUnavailable(
                f"{self._shared_bytes} bytes that a block's threads share, {MAX_SHARED_BYTES} at most",
                "take fewer bodies and effects",
            )

    def launch(self, name: str, ports: Tensor, work: Tensor, scenes: int, *rest: ctypes._SimpleCData) -> None:
        """Start a kernel with one block for each scene."""
        if self.data.is_cuda:  # another program may take this one's memory before it is done
            for t in (self.data, self.tables):
                t.record_stream(torch.cuda.current_stream(t.device))
        pointers = (ctypes.c_void_p(t.data_ptr()) for t in (ports, self.data, self.tables, work))
        self.kernels.launch(name, scenes, self._shared_bytes, [*pointers, *rest])


_device_programs: WeakKeyDictionary[Program, dict[torch.device, DeviceProgram]] = WeakKeyDictionary()


def device_program(program: Program, device: torch.device) -> DeviceProgram:
    """Return the program on a device, and compile it first if it is new there.

    Raises:
        EngineUnavailable: it cannot be compiled.
    """
    by_device = _device_programs.setdefault(program, {})
    if device not in by_device:
        module = CudaModule(program.recorded_calls, program.dtype)
        by_device[device] = DeviceProgram(module, kernels(module.text, device), device, program.dtype)
    return by_device[device]


def kernels(text: str, device: torch.device) -> Device:
    """Return the kernels of a text, compiled for a device.

    Raises:
        EngineUnavailable: they cannot be compiled.
    """
    result = _compile_once(text, device)
    if isinstance(result, EngineUnavailable):
        raise EngineUnavailable(str(result), result.remedy)
    return result


@lru_cache(maxsize=MAX_CACHED_PROGRAMS)
def _compile_once(text: str, device: torch.device) -> DeviceKernels | EngineUnavailable:
    """Compile once, also where it failed."""
    try:
        return DeviceKernels(text, THREADS_PER_BLOCK, device)
    except EngineUnavailable as reason:
        return reason


def forward(job: Job, keep_masks: bool = True) -> tuple[dict[Field, Tensor], Tensor]:
    """Run the substeps.

    Args:
        job: program and numbers.
        keep_masks: return the masks of contact; else none.

    Returns:
        States after the substeps and sums [scenes, (frames,) rows, comps], and the masks: one bit for each triangle and
        substep that says whether the triangle was active.

    Raises:
        InvalidInput: contact has more nodes than there is room for.
    """
    like = job.like
    compiled = device_program(job.program, like.device)
    results = {f: like.new_empty(job.scenes, *job.frames, f.rows, f.comps) for f in job.program.outputs}
    work = like.new_zeros(job.scenes * compiled.module.values_size)
    size = mask_size(compiled.module, job.substeps if keep_masks else 2)
    masks = like.new_zeros(job.scenes, size, dtype=torch.uint8)
    grids = like.new_empty(job.scenes, compiled.module.grid_size, dtype=torch.int32)
    ends = _to_device(torch.tensor(job.frame_ends or (job.substeps,)), like.device)
    ports = _ports(job, like.device, results=results)
    counts = ctypes.c_int(job.substeps), ctypes.c_int(len(ends)), ctypes.c_int(keep_masks)
    pointers = (ctypes.c_void_p(t.data_ptr()) for t in (masks, grids, ends))
    compiled.launch("values", ports, work, job.scenes, *pointers, *counts)
    if masks.numel() and bool(masks[:, -1].any()):
        raise InvalidInput(
            "contact grid",
            got="more nodes than there is room for",
            expected=f"at most {compiled.module.node_slots} around the points of a scene",
            remedy='a shorter dt where it diverges; a wider contact (tc.Contact.with_gap), or engine="reference"',
        )
    return results, _pack_bits(masks) if keep_masks else masks[:, :0]


def _pack_bits(masks: Tensor) -> Tensor:
    """Eight numbers in a byte, a few scenes at a time."""
    places, packed = torch.arange(8, dtype=torch.uint8, device=masks.device), []
    for chunk in masks.split(max(1, STATE_BUDGET_BYTES // max(8 * masks.shape[-1], 1))):
        padded = torch.nn.functional.pad(chunk, (0, -chunk.shape[-1] % 8)).unflatten(-1, (-1, 8))
        packed.append((padded << places).sum(-1, dtype=torch.uint8))
    return torch.cat(packed)


def _unpack_bits(bits: Tensor, size: int) -> Tensor:
    """[scenes, size] numbers of as many bits."""
    numbers = bits.unsqueeze(-1) >> torch.arange(8, dtype=torch.uint8, device=bits.device)
    return (numbers & 1).flatten(-2)[..., :size].contiguous()


def mask_size(module: CudaModule, substeps: int) -> int:
    """Return the bytes of a scene: one for each triangle and substep, and one that says whether room was lacking."""
    return 0 if module.contact is None else substeps * module.mask_size + 1


def reverse(
    job: Job, masks: Tensor, seeds: Mapping[Field, Tensor], wanted: set[Field], chunk: int | None = None
) -> dict[Field, Tensor]:
    """Return the adjoints [scenes, rows, comps] of the wanted inputs, from those of the results.

    Args:
        job: program and numbers.
        masks: of ``forward``.
        seeds: adjoints of the results.
        wanted: fields of the inputs.
        chunk: substeps whose states are kept at a time; None: as many as the budget allows.
    """
    like = job.like
    compiled = device_program(job.program, like.device)
    module = compiled.module
    states = [f for f in job.program.inputs if f.kind == FieldKind.STATE]
    next_states = [f for f in job.program.outputs if f.kind == FieldKind.NEXT]
    after = dict(zip(states, next_states, strict=True))
    if chunk is None:
        size = module.state_size * job.scenes * job.program.dtype.itemsize
        # states at the starts of all chunks are kept at once: a chunk is no shorter than the root of all substeps
        fits = min(max(STATE_BUDGET_BYTES // max(size, 1), MIN_CHUNK_SUBSTEPS), MAX_CHUNK_SUBSTEPS)
        chunk = max(fits, isqrt(job.substeps))
    ends = [*range(0, job.substeps, chunk), job.substeps]
    starts = _states_at(job, ends[1:-1])
    gradients = {f: like.new_zeros(job.scenes, *job.inputs[f].shape[1:]) for f in wanted}
    state_gradients = {f: like.new_zeros(job.scenes, f.rows, f.comps) for f in states}  # before the present chunk
    work = like.new_zeros(job.scenes * (module.adjoint_size + min(chunk, job.substeps) * module.state_size))
    grids = like.new_empty(job.scenes, module.grid_size, dtype=torch.int32)
    masks = _unpack_bits(masks, mask_size(module, job.substeps))
    chunk_seeds = {f: t.contiguous() for f, t in seeds.items()}
    for k in reversed(range(len(ends) - 1)):
        first, last = ends[k], ends[k + 1]
        now = {f: starts[after[f]][:, k - 1].contiguous() for f in states} if k else {}
        chunk_job = job._replace(inputs={**job.inputs, **now})
        ports = _ports(chunk_job, like.device, seeds=chunk_seeds, gradients={**gradients, **state_gradients})
        counts = ctypes.c_int(last - first), ctypes.c_int(first), ctypes.c_int(job.substeps)
        pointers = (ctypes.c_void_p(t.data_ptr()) for t in (masks, grids))
        compiled.launch("adjoint", ports, work, job.scenes, *pointers, *counts)
        chunk_seeds = {**chunk_seeds, **{after[f]: t.clone() for f, t in state_gradients.items()}}
    return {f: state_gradients.get(f, gradients[f]) for f in wanted}


def _states_at(job: Job, ends: Sequence[int]) -> dict[Field, Tensor]:
    """Results after some of the substeps."""
    if not ends:
        return {}
    per_substep = {f: t for f, t in job.inputs.items() if f.kind == FieldKind.PER_SUBSTEP}
    rows = {f: t[:, : ends[-1]].contiguous() for f, t in per_substep.items()}
    shorter = job._replace(inputs={**job.inputs, **rows}, substeps=ends[-1], frame_ends=tuple(ends))
    return forward(shorter, keep_masks=False)[0]


def _ports(
    job: Job,
    device: torch.device,
    results: Mapping[Field, Tensor] | None = None,
    seeds: Mapping[Field, Tensor] | None = None,
    gradients: Mapping[Field, Tensor] | None = None,
) -> Tensor:
    """Addresses of the program's fields: value, stride, result, seed, gradient of each."""
    ports = np.zeros((len(job.program.fields), POINTERS_PER_PORT), np.int64)
    for f, t in job.inputs.items():
        shape = (job.substeps if f.kind == FieldKind.PER_SUBSTEP else f.rows, f.comps)
        if not t.is_contiguous() or t.dtype != job.program.dtype or t.device != device:
            raise ValueError(f"{f}: not contiguous, of another precision, or elsewhere than on {device}")
        if t.shape[1:] != shape or len(t) not in (1, job.scenes):
            raise ValueError(f"{f}: got shape {list(t.shape)}, expected [1 or {job.scenes}, {shape[0]}, {shape[1]}]")
        ports[f.id, 0], ports[f.id, 1] = t.data_ptr(), t[0].numel() if len(t) > 1 else 0
    for column, tensors in ((2, results), (3, seeds), (4, gradients)):
        for f, t in (tensors or {}).items():
            ports[f.id, column] = t.data_ptr()
    return _to_device(torch.from_numpy(ports), device)


def _to_device(numbers: Tensor, device: torch.device) -> Tensor:
    """A copy on the device, without waiting for it."""
    return numbers.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else numbers
