"""Linearisations drawn from a linear model with known noise, to compare statistics with theory without a cloth."""

from __future__ import annotations

import torch

from torchcloth.diagnosis.data.binning import BLOCK_NAMES, BinnedResiduals
from torchcloth.diagnosis.inference.fitting import ModelFit
from torchcloth.diagnosis.inference.linearise import Linearisation
from torchcloth.diagnosis.inference.noise import Noise, whiten
from torchcloth.episodes.world import BaseParameter, Hypothesis, WorldModel

EPISODE_COUNT, PATCH_COUNT, WINDOW_COUNT = 4, 16, 6
WHITE_NOISE_M, SLOW_ERROR_M, NUISANCE_STD_M = 2e-4, 8e-4, 1.5e-3  # m


def make_hypothesis(name: str, typical: float = 1.0, **options) -> Hypothesis:
    return Hypothesis(name, "-", typical, lambda world, _: world, signed=True, **options)


def make_parameter(name: str, std: float = 0.5) -> BaseParameter:
    return BaseParameter(name, "-", 0.1, std, lambda world, _: world, lambda x: x)


def make_cells() -> BinnedResiduals:
    """Return the cells of one episode without values: a square of 0.3 m in 4 x 4 patches."""
    patch, window = (
        i.flatten() for i in torch.meshgrid(torch.arange(PATCH_COUNT), torch.arange(WINDOW_COUNT), indexing="ij")
    )
    place = torch.stack([(patch // 4) * 0.075, (patch % 4) * 0.075, torch.full(patch.shape, 0.01)], 1).double()
    size = len(patch)
    one = torch.ones(size).double()
    return BinnedResiduals(
        torch.zeros(size).double(), torch.zeros(size, 0).double(), 25 * one, 5 * WHITE_NOISE_M * one,
        torch.zeros(size).long(), 3 * patch, window, place, 0.2 * window.double(),
        torch.zeros(size).double(), torch.zeros(size).double(),
    )  # fmt: skip


def draw_jacobian(seed: int, columns: int) -> torch.Tensor:
    """Return a Jacobian [EPISODE_COUNT, C, columns] m per unit that varies over centimetres and tenths of a second."""
    rng = torch.Generator().manual_seed(seed)
    cells = make_cells()
    basis = torch.cat([cells.rest_position[:, :2] / 0.3, cells.time[:, None]], 1)
    waves = torch.randn(EPISODE_COUNT, 3, columns, generator=rng).double() * 3
    shift = 6.3 * torch.rand(EPISODE_COUNT, 1, columns, generator=rng).double()
    return 5e-3 * torch.sin(basis @ waves + shift)


def draw_linearisation(
    jacobian: torch.Tensor, parameter_count: int, names: list[str], truth: torch.Tensor, seed: int
) -> Linearisation:
    """Return residuals of a world that differs from the model by ``truth`` [parameter_count + names].

    The last column of the Jacobian belongs to a nuisance.
    """
    rng = torch.Generator().manual_seed(1000 + seed)
    level = torch.zeros(len(BLOCK_NAMES)).double()
    level[0] = SLOW_ERROR_M
    cells, stds = [], []
    for episode_jacobian in jacobian:
        cell = make_cells()._replace(jacobian=episode_jacobian)
        root = torch.linalg.cholesky(
            Noise(level).covariance(cell, episode_jacobian[:, -1:], torch.tensor([NUISANCE_STD_M]).double())
        )
        noise = root @ torch.randn(len(root), generator=rng).double()
        cells.append(cell._replace(value=noise - episode_jacobian[:, :-1] @ truth))
        stds.append(torch.tensor([NUISANCE_STD_M]).double())
    hypotheses = [make_hypothesis(name) for name in names]
    return Linearisation(cells, parameter_count, hypotheses, stds, [torch.zeros_like(c.value) for c in cells])


def make_model_fit(linearisation: Linearisation, level: float = SLOW_ERROR_M, std: float = 0.5) -> ModelFit:
    """Return the fitted model at the point of linearisation, as ``fit`` does."""
    levels = torch.full((len(BLOCK_NAMES),), level).double()
    model = WorldModel(
        None,
        tuple(make_parameter(f"p{k}", std) for k in range(linearisation.n_coordinates)),
        torch.zeros(linearisation.n_coordinates).double(),
    )  # type: ignore[arg-type]
    white = whiten(linearisation, Noise(levels))
    parameter_jacobian = white.jacobian[:, : linearisation.n_coordinates]
    covariance = torch.linalg.inv(
        parameter_jacobian.mT @ parameter_jacobian + torch.eye(linearisation.n_coordinates).double() / std**2
    )
    return ModelFit(model, linearisation, Noise(levels), white, covariance, 0.0)
