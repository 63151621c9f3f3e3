"""Running a program on a device: values, and adjoints by going through a few substeps at a time again."""

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
from ..building import Unbuilt
from ..execution import Job
from ..fields import Field, Kind
from ..program import MOST_KEPT, Program
from .codegen import Source
from .driver import Kernels

BUDGET = 256 * 2**20  # bytes of states that an adjoint keeps at a time
MOST, FEWEST = 64, 8  # substeps of that
THREADS = 512  # of a block; measured with 441 vertices, by how many scenes there are it hardly matters
SHARED = 48 * 2**10  # bytes, for which a device need not be asked
PORT = 5  # numbers of 64 bits, as in source.py


class Device(Protocol):
    """What has kernels."""

    threads: int

    def launch(self, name: str, blocks: int, shared: int, arguments: Sequence[ctypes._SimpleCData]) -> None:
        """Start one of them; ``shared``: bytes for each block."""
        ...


class OnDevice:
    """A program on one device.

    Attributes:
        tried: whether it was compared with the processor.
        doubt: what it did instead, and what to do about it.
    """

    tried = False
    doubt: tuple[str, str] | None = None

    def __init__(self, source: Source, kernels: Device, device: torch.device, dtype: torch.dtype) -> None:
        self.source, self.kernels = source, kernels
        self.data = torch.from_numpy(source.data).to(device, dtype)
        self.tables = torch.from_numpy(source.tables).to(device)
        warps = -(-kernels.threads // 32) if device.type == "cuda" else kernels.threads
        self._shared = source.shared * (1 + warps) * dtype.itemsize
        if self._shared > SHARED:
            raise Unbuilt(
                f"{self._shared} bytes that a block's threads share, {SHARED} at most", "take fewer bodies and effects"
            )

    def launch(self, name: str, ports: Tensor, work: Tensor, scenes: int, *rest: ctypes._SimpleCData) -> None:
        """One block for each scene."""
        if self.data.is_cuda:  # other programs may take this one's place before it is done
            for t in (self.data, self.tables):
                t.record_stream(torch.cuda.current_stream(t.device))
        known = (ctypes.c_void_p(t.data_ptr()) for t in (ports, self.data, self.tables, work))
        self.kernels.launch(name, scenes, self._shared, [*known, *rest])


_KNOWN: WeakKeyDictionary[Program, dict[torch.device, OnDevice]] = WeakKeyDictionary()


def on_device(program: Program, device: torch.device) -> OnDevice:
    """The program there, compiled if need be.

    Raises:
        Unbuilt: it cannot be compiled.
    """
    known = _KNOWN.setdefault(program, {})
    if device not in known:
        source = Source(program.written, program.dtype)
        known[device] = OnDevice(source, kernels(source.text, device), device, program.dtype)
    return known[device]


def kernels(text: str, device: torch.device) -> Device:
    """The text, compiled for a device.

    Raises:
        Unbuilt: it cannot be.
    """
    found = _kernels(text, device)
    if isinstance(found, Unbuilt):
        raise Unbuilt(str(found), found.remedy)
    return found


@lru_cache(maxsize=MOST_KEPT)
def _kernels(text: str, device: torch.device) -> Kernels | Unbuilt:
    """Once, also where it failed."""
    try:
        return Kernels(text, THREADS, device)
    except Unbuilt as miss:
        return miss


def forward(job: Job, keep: bool = True) -> tuple[dict[Field, Tensor], Tensor]:
    """(nexts and sums [scenes, (frames,) rows, comps], bits: which triangles met others, substep by substep).

    ``keep``: these; else none.

    Raises:
        InvalidInput: contact has more nodes than there is room for.
    """
    like = job.like
    there = on_device(job.program, like.device)
    results = {f: like.new_empty(job.scenes, *job.frames, f.rows, f.comps) for f in job.program.outputs}
    work = like.new_zeros(job.scenes * there.source.values_size)
    size = mask_size(there.source, job.substeps if keep else 2)
    masks = like.new_zeros(job.scenes, size, dtype=torch.uint8)
    grids = like.new_empty(job.scenes, there.source.grid_size, dtype=torch.int32)
    ends = _there(torch.tensor(job.ends or (job.substeps,)), like.device)
    ports = _ports(job, like.device, results=results)
    counts = ctypes.c_int(job.substeps), ctypes.c_int(len(ends)), ctypes.c_int(keep)
    pointers = (ctypes.c_void_p(t.data_ptr()) for t in (masks, grids, ends))
    there.launch("values", ports, work, job.scenes, *pointers, *counts)
    if masks.numel() and bool(masks[:, -1].any()):
        raise InvalidInput(
            "contact grid",
            got="more nodes than there is room for",
            expected=f"at most {there.source.room} around the points of a scene",
            remedy='a shorter dt where it diverges; a wider contact (tc.Contact.with_gap), or engine="reference"',
        )
    return results, _packed(masks) if keep else masks[:, :0]


def _packed(masks: Tensor) -> Tensor:
    """Eight in a byte, a few scenes at a time."""
    places, found = torch.arange(8, dtype=torch.uint8, device=masks.device), []
    for some in masks.split(max(1, BUDGET // max(8 * masks.shape[-1], 1))):
        padded = torch.nn.functional.pad(some, (0, -some.shape[-1] % 8)).unflatten(-1, (-1, 8))
        found.append((padded << places).sum(-1, dtype=torch.uint8))
    return torch.cat(found)


def _unpacked(bits: Tensor, size: int) -> Tensor:
    """[scenes, size] of as many bits."""
    found = bits.unsqueeze(-1) >> torch.arange(8, dtype=torch.uint8, device=bits.device)
    return (found & 1).flatten(-2)[..., :size].contiguous()


def mask_size(source: Source, substeps: int) -> int:
    """Of a scene: a number for each triangle in each substep, and whether there was no room."""
    return 0 if source.layers is None else substeps * source.mask_size + 1


def reverse(
    job: Job, masks: Tensor, seeds: Mapping[Field, Tensor], wanted: set[Field], chunk: int | None = None
) -> dict[Field, Tensor]:
    """Adjoints [scenes, rows, comps] of the wanted inputs, from those of nexts and sums; ``masks``: ``forward``'s.

    ``chunk``: substeps whose states are kept at a time; None: by what there is room for.
    """
    like = job.like
    there = on_device(job.program, like.device)
    states = [f for f in job.program.inputs if f.kind == Kind.STATE]
    after = dict(zip(states, [f for f in job.program.outputs if f.kind == Kind.NEXT], strict=True))
    if chunk is None:
        size = there.source.state_size * job.scenes * job.program.dtype.itemsize
        # the states at the starts of all chunks are there at once: no shorter than the root of all
        chunk = max(min(max(BUDGET // max(size, 1), FEWEST), MOST), isqrt(job.substeps))
    ends = [*range(0, job.substeps, chunk), job.substeps]
    starts = _states(job, ends[1:-1])
    grads = {f: like.new_zeros(job.scenes, *job.inputs[f].shape[1:]) for f in wanted}
    mine = {f: like.new_zeros(job.scenes, f.rows, f.comps) for f in states}  # before the present chunk
    work = like.new_zeros(job.scenes * (there.source.adjoint_size + min(chunk, job.substeps) * there.source.state_size))
    grids = like.new_empty(job.scenes, there.source.grid_size, dtype=torch.int32)
    masks = _unpacked(masks, mask_size(there.source, job.substeps))
    given = {f: t.contiguous() for f, t in seeds.items()}
    for k in reversed(range(len(ends) - 1)):
        first, last = ends[k], ends[k + 1]
        now = {f: starts[after[f]][:, k - 1].contiguous() for f in states} if k else {}
        ports = _ports(
            job._replace(inputs={**job.inputs, **now}), like.device, seeds=given, gradients={**grads, **mine}
        )
        counts = ctypes.c_int(last - first), ctypes.c_int(first), ctypes.c_int(job.substeps)
        pointers = (ctypes.c_void_p(t.data_ptr()) for t in (masks, grids))
        there.launch("adjoint", ports, work, job.scenes, *pointers, *counts)
        given = {**given, **{after[f]: t.clone() for f, t in mine.items()}}
    return {f: mine.get(f, grads[f]) for f in wanted}


def _states(job: Job, ends: Sequence[int]) -> dict[Field, Tensor]:
    """Results after some of the substeps; none of none."""
    if not ends:
        return {}
    drives = {f: t[:, : ends[-1]].contiguous() for f, t in job.inputs.items() if f.kind == Kind.DRIVE}
    return forward(job._replace(inputs={**job.inputs, **drives}, substeps=ends[-1], ends=tuple(ends)), keep=False)[0]


def _ports(
    job: Job,
    device: torch.device,
    results: Mapping[Field, Tensor] | None = None,
    seeds: Mapping[Field, Tensor] | None = None,
    gradients: Mapping[Field, Tensor] | None = None,
) -> Tensor:
    """Where the program's fields are, field by field."""
    ports = np.zeros((len(job.program.fields), PORT), np.int64)
    for f, t in job.inputs.items():
        shape = (job.substeps if f.kind == Kind.DRIVE else f.rows, f.comps)
        if not t.is_contiguous() or t.dtype != job.program.dtype or t.device != device:
            raise ValueError(f"{f}: not contiguous, of another precision, or elsewhere than on {device}")
        if t.shape[1:] != shape or len(t) not in (1, job.scenes):
            raise ValueError(f"{f}: got shape {list(t.shape)}, expected [1 or {job.scenes}, {shape[0]}, {shape[1]}]")
        ports[f.id, 0], ports[f.id, 1] = t.data_ptr(), t[0].numel() if len(t) > 1 else 0
    for column, tensors in ((2, results), (3, seeds), (4, gradients)):
        for f, t in (tensors or {}).items():
            ports[f.id, column] = t.data_ptr()
    return _there(torch.from_numpy(ports), device)


def _there(numbers: Tensor, device: torch.device) -> Tensor:
    """On the device, for which nobody waits."""
    return numbers.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else numbers
