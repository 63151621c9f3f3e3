"""Which engine runs a cloth, and why."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from typing import Literal, NamedTuple, get_args

import torch

from .._utils.torch_modes import transformed
from ..boundaries import Drive
from ..dynamics.model import Model
from ..errors import InvalidInput
from ..types import ClothState
from . import devices
from .execution import Job
from .fused import Fused
from .library import Unbuilt, library
from .lowering import Unfused

Setting = Literal["auto", "reference", "fused"]
TRIALS, TRIED = 3, 16  # of a device: at most so many, of so many substeps


class Choice(NamedTuple):
    """The fused engine, or None for the reference; and the reason in words."""

    fused: Fused | None
    reason: str
    captured: bool = False  # substeps of the reference, as CUDA graphs

    def __str__(self) -> str:
        if self.fused is None:
            return f"reference{', in CUDA graphs' if self.captured else ''} ({self.reason})"
        parts = () if self.fused.torch_parts is None else sorted(self.fused.torch_parts.parts)
        return f"fused, with {', '.join(parts)} in torch" if parts else "fused"


def check_setting(setting: str) -> Setting:
    """One of "auto", "reference", "fused".

    Raises:
        InvalidInput: anything else.
    """
    if setting not in get_args(Setting):
        raise InvalidInput("engine", got=repr(setting), expected='"auto", "reference" or "fused"')
    return setting  # type: ignore[return-value]


class Trial(NamedTuple):
    """On what a device is tried."""

    begin: Callable[[torch.Size, int], ClothState]  # scenes, by their batch and a seed
    dt: float  # s


def choose(
    setting: Setting,
    model: Model,
    state: ClothState,
    drives: Mapping[str, Drive],
    trial: Trial | None = None,
) -> Choice:
    """The engine for one call; warns once per process where only a compiler is missing.

    ``trial``: on what a device is tried that was not yet; None: it is not.

    Raises:
        InvalidInput: ``setting`` is "fused" and it cannot be.
    """
    if setting == "reference":
        return Choice(None, "as asked for")
    remedy = 'use engine="auto", which falls back to the reference'
    try:
        if devices.elsewhere(state.x):
            return _on_device(model, state, drives, trial)
        return Choice(_fused(model, state, drives), "")
    except Unfused as miss:
        reason = f"{miss} has no kernels"
    except _Elsewhere as miss:
        reason = str(miss)
    except Unbuilt as miss:
        reason = str(miss)
        remedy = f'{miss.remedy}, or use engine="auto"'
        if setting == "auto":
            _warn(f"{reason}: simulations run on the torch reference, tens of times slower; {miss.remedy}")
    if setting == "fused":
        raise InvalidInput(
            "engine", got='"fused"', expected=f"a cloth that the engine can run: {reason}", remedy=remedy
        )
    return Choice(None, reason, captured=state.x.is_cuda and not transformed())


def still_drives(model: Model, substeps: int = 1) -> dict[str, Drive]:
    """Drives in which every driven boundary is closed and stands still, to try an engine on."""
    still = torch.eye(4, dtype=model.mass.dtype, device=model.mass.device).repeat(substeps, 1, 1)
    closed = (True,) * substeps
    return {name: Drive(still, still, closed) for name, boundary in model.boundaries.items() if boundary.driven}


class _Elsewhere(Exception):
    """Tensors that the engine does not take."""


def _on_device(model: Model, state: ClothState, drives: Mapping[str, Drive], trial: Trial | None) -> Choice:
    """On CUDA; parts in torch are the reference's, as are tangents."""
    if transformed():
        raise _Elsewhere("tangents on cuda")
    _check_dtype(state)
    library()  # it knows the kernels
    fused = Fused(model, state, drives)
    if fused.torch_parts is not None:
        raise _Elsewhere(f"{', '.join(sorted(fused.torch_parts.parts))} in torch, on cuda")
    tried = devices.prepare(fused.low.program, state.x.device)
    if not tried and trial is not None:
        devices.try_out(_trials(model, state.x.shape[:-2], trial), fused.rounding)
    return Choice(fused, "")


def _trials(model: Model, batch: torch.Size, trial: Trial) -> Iterator[Job]:
    """Of two scenes each, with numbers that nobody derives."""
    drives, batch = still_drives(model, TRIED), batch if batch.numel() > 1 else torch.Size((2,))
    steps = torch.full((TRIED,), trial.dt, dtype=torch.float64)
    for seed in range(TRIALS):
        with torch.no_grad():
            state = trial.begin(batch, seed)
            job = Fused(model, state, drives).job(state, steps, drives)
        yield job._replace(inputs={f: t[:2] for f, t in job.inputs.items()}, scenes=2)


def _fused(model: Model, state: ClothState, drives: Mapping[str, Drive]) -> Fused:
    if state.x.device.type != "cpu":
        raise _Elsewhere(f"tensors on {state.x.device.type}")
    _check_dtype(state)
    library()
    return Fused(model, state, drives)


def _check_dtype(state: ClothState) -> None:
    if state.x.dtype not in (torch.float32, torch.float64):
        raise _Elsewhere(str(state.x.dtype).removeprefix("torch."))


@cache
def _warn(text: str) -> None:
    warnings.warn(text, stacklevel=6)
