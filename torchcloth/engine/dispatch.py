"""Which engine runs a cloth, and why."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from typing import Literal, NamedTuple, get_args

import torch

from .._utils.torch_modes import under_torch_transform
from ..boundaries import PrescribedMotion
from ..dynamics.model import Model
from ..errors import InvalidInput
from ..types import ClothState
from . import devices
from .builder import UnsupportedPart
from .execution import Job
from .fused import FusedEngine
from .library import EngineUnavailable, library

Setting = Literal["auto", "reference", "fused"]
SELF_TEST_SEEDS = 3  # states on which a device is compared with the CPU, at most
SELF_TEST_SUBSTEPS = 16


class EngineChoice(NamedTuple):
    """The engine of a call.

    Attributes:
        fused: the fused engine; None: the reference.
        reason: why, for a user.
        uses_cuda_graphs: substeps of the reference run as CUDA graphs.
    """

    fused: FusedEngine | None
    reason: str
    uses_cuda_graphs: bool = False

    def __str__(self) -> str:
        if self.fused is None:
            return f"reference{', in CUDA graphs' if self.uses_cuda_graphs else ''} ({self.reason})"
        parts = () if self.fused.torch_parts is None else sorted(self.fused.torch_parts.parts)
        return f"fused, with {', '.join(parts)} in torch" if parts else "fused"


class SelfTest(NamedTuple):
    """Inputs of the one-time self-test that compares a device with the CPU engine.

    Attributes:
        initial_state: returns a state for a batch shape and a seed.
        dt: substep [s].
    """

    initial_state: Callable[[torch.Size, int], ClothState]
    dt: float


def check_setting(setting: str) -> Setting:
    """Return the setting if it is "auto", "reference" or "fused".

    Raises:
        InvalidInput: it is anything else.
    """
    if setting not in get_args(Setting):
        raise InvalidInput("engine", got=repr(setting), expected='"auto", "reference" or "fused"')
    return setting  # type: ignore[return-value]


def choose_engine(
    setting: Setting,
    model: Model,
    state: ClothState,
    prescribed: Mapping[str, PrescribedMotion],
    self_test: SelfTest | None = None,
) -> EngineChoice:
    """Return the engine for one call; warn once per process where only a compiler is missing.

    Args:
        setting: "auto", "reference" or "fused".
        model: the model.
        state: the initial state.
        prescribed: motions by boundary.
        self_test: inputs for a device that was not tested yet; None: it is not tested.

    Raises:
        InvalidInput: ``setting`` is "fused", and the fused engine cannot run this cloth.
    """
    if setting == "reference":
        return EngineChoice(None, "as asked for")
    remedy = 'use engine="auto", which falls back to the reference'
    try:
        if devices.is_on_device(state.x):
            return _choose_on_device(model, state, prescribed, self_test)
        return EngineChoice(_fused_on_cpu(model, state, prescribed), "")
    except UnsupportedPart as error:
        reason = f"{error} has no kernels"
    except _UnsupportedTensors as error:
        reason = str(error)
    except EngineUnavailable as error:
        reason = str(error)
        remedy = f'{error.remedy}, or use engine="auto"'
        if setting == "auto":
            _warn_once(f"{reason}: simulations run on the torch reference, tens of times slower; {error.remedy}")
    if setting == "fused":
        raise InvalidInput(
            "engine", got='"fused"', expected=f"a cloth that the engine can run: {reason}", remedy=remedy
        )
    return EngineChoice(None, reason, uses_cuda_graphs=state.x.is_cuda and not under_torch_transform())


def stationary_prescribed(model: Model, substeps: int = 1) -> dict[str, PrescribedMotion]:
    """Return motions in which every prescribed boundary is closed and stands still."""
    identity = torch.eye(4, dtype=model.mass.dtype, device=model.mass.device).repeat(substeps, 1, 1)
    closed = (True,) * substeps
    return {
        name: PrescribedMotion(identity, identity, closed)
        for name, part in model.boundaries.items()
        if part.is_prescribed
    }


class _UnsupportedTensors(Exception):
    """Tensors that the engine does not take."""


def _choose_on_device(
    model: Model, state: ClothState, prescribed: Mapping[str, PrescribedMotion], self_test: SelfTest | None
) -> EngineChoice:
    """On CUDA, the reference computes models with parts in torch, and tangents."""
    if under_torch_transform():
        raise _UnsupportedTensors("tangents on cuda")
    _check_dtype(state)
    library()  # it knows the kernels
    fused = FusedEngine(model, state, prescribed)
    if fused.torch_parts is not None:
        raise _UnsupportedTensors(f"{', '.join(sorted(fused.torch_parts.parts))} in torch, on cuda")
    is_tested = devices.prepare(fused.builder.program, state.x.device)
    if not is_tested and self_test is not None:
        devices.run_self_test(_self_test_jobs(model, state.x.shape[:-2], self_test), fused.rounding)
    return EngineChoice(fused, "")


def _self_test_jobs(model: Model, batch: torch.Size, self_test: SelfTest) -> Iterator[Job]:
    """Jobs of two scenes each, with plain numbers."""
    prescribed = stationary_prescribed(model, SELF_TEST_SUBSTEPS)
    batch = batch if batch.numel() > 1 else torch.Size((2,))
    steps = torch.full((SELF_TEST_SUBSTEPS,), self_test.dt, dtype=torch.float64)
    for seed in range(SELF_TEST_SEEDS):
        with torch.no_grad():
            state = self_test.initial_state(batch, seed)
            job = FusedEngine(model, state, prescribed).job(state, steps, prescribed)
        yield job._replace(inputs={f: t[:2] for f, t in job.inputs.items()}, scenes=2)


def _fused_on_cpu(model: Model, state: ClothState, prescribed: Mapping[str, PrescribedMotion]) -> FusedEngine:
    if state.x.device.type != "cpu":
        raise _UnsupportedTensors(f"tensors on {state.x.device.type}")
    _check_dtype(state)
    library()
    return FusedEngine(model, state, prescribed)


def _check_dtype(state: ClothState) -> None:
    if state.x.dtype not in (torch.float32, torch.float64):
        raise _UnsupportedTensors(str(state.x.dtype).removeprefix("torch."))


@cache
def _warn_once(text: str) -> None:
    warnings.warn(text, stacklevel=6)
