"""Least-squares problems with known solutions, in the form that the solver takes. No simulation."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchcloth.identification.estimators.levenberg_marquardt import DEFAULT_NOISE_MODEL, Linearised, Problem, minimise

FRAME_COUNT, PATCH_COUNT, POINTS_PER_PATCH = 40, 16, 3  # rows: 40 frames of 16 patches of 3 points
SIGMA_M = 1e-3
TRUE_UNKNOWNS = torch.tensor([0.4, -0.3, 0.7], dtype=torch.float64)
Model = Callable[[Tensor], Tensor]


@dataclass
class ToyProblem:
    """The residual ``model(raw) - data``, with a log of the points that the solver evaluates."""

    model: Model
    data: Tensor
    frame: Tensor
    patch: Tensor
    prior_std: float = 5.0
    unknowns: int = len(TRUE_UNKNOWNS)
    forbidden: Callable[[Tensor], Exception | None] = lambda raw: None
    linearised: list[Tensor] = field(default_factory=list)
    evaluated: list[Tensor] = field(default_factory=list)

    def problem(self) -> Problem:
        """Return the problem in the solver's form."""
        mean = torch.zeros(self.unknowns, dtype=torch.float64)
        std = torch.full_like(mean, self.prior_std)
        return Problem(
            linearise=self._linearise,
            evaluate=self._evaluate,
            clip=lambda raw: raw,
            prior_mean=mean,
            prior_std=std,
            max_step=torch.ones_like(mean),
            noise_floor=None,
        )

    def _linearise(self, raw: Tensor) -> Linearised:
        self.linearised.append(raw)
        jacobian = torch.func.jacfwd(self.model)(raw)
        factor = torch.ones(len(self.data), dtype=torch.float64)
        return Linearised(self.model(raw) - self.data, jacobian, factor, self.frame, self.patch)

    def _evaluate(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        self.evaluated.append(raw)
        error = self.forbidden(raw)
        if error is not None:
            raise error
        return self.model(raw) - self.data, self.patch


def row_layout(frames: int = FRAME_COUNT) -> tuple[Tensor, Tensor]:
    """Return frame and patch of every row; frame 0 has none, as in an episode."""
    frame = torch.arange(1, frames + 1).repeat_interleave(PATCH_COUNT * POINTS_PER_PATCH)
    patch = torch.arange(PATCH_COUNT).repeat_interleave(POINTS_PER_PATCH).repeat(frames)
    return frame, patch


def draw_jacobian(generator: torch.Generator, frames: int = FRAME_COUNT, unknowns: int = len(TRUE_UNKNOWNS)) -> Tensor:
    """Return a Jacobian [R, K] m that is smooth over time and equal within a patch, as that of a fabric."""
    frame, patch = row_layout(frames)
    phase, rate = torch.rand(2, PATCH_COUNT, unknowns, generator=generator, dtype=torch.float64)
    t = frame[:, None] / FRAME_COUNT
    return 2e-3 * torch.sin(2 * math.pi * (phase[patch] + (0.5 + rate[patch]) * t))


def draw_noise(generator: torch.Generator, shared: float, frames: int = FRAME_COUNT) -> Tensor:
    """Return noise [R] m: independent, and ``shared`` times as large a part that is common to a patch and window.

    The windows begin two frames after those of the solver, because real errors do not respect them.
    """
    frame, patch = row_layout(frames)
    window = (frame + 2) // DEFAULT_NOISE_MODEL.frames_per_time_block
    common = torch.randn(int(window.max()) + 1, PATCH_COUNT, generator=generator, dtype=torch.float64)
    alone = torch.randn(len(frame), generator=generator, dtype=torch.float64)
    return SIGMA_M * (alone + shared * common[window, patch])


def make_linear_problem(seed: int, shared: float = 0.0) -> tuple[ToyProblem, Tensor]:
    """Return a linear problem and its Jacobian."""
    generator = torch.Generator().manual_seed(seed)
    jacobian = draw_jacobian(generator)
    return ToyProblem(
        lambda raw: jacobian @ raw, jacobian @ TRUE_UNKNOWNS + draw_noise(generator, shared), *row_layout()
    ), jacobian


def make_curved_problem(seed: int = 0, bend: float = 1.0) -> ToyProblem:
    """Return a problem in exponentials of the unknowns, whose Jacobian changes between start and solution."""
    generator = torch.Generator().manual_seed(seed)
    jacobian = draw_jacobian(generator)

    def model(raw: Tensor) -> Tensor:
        return jacobian @ (torch.expm1(bend * raw) / bend)

    return ToyProblem(model, model(TRUE_UNKNOWNS) + draw_noise(generator, 0.0), *row_layout())


START_UNKNOWNS = torch.zeros(3, dtype=torch.float64)


def solve(toy, iterations=35, start=START_UNKNOWNS, **options):
    return minimise(toy.problem(), start, iterations, lambda _: False, **options)
