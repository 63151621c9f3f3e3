"""Where on the fabric, in which motion and when a cause shows: its effect beyond what fitted parameters could do."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import torch
from torch import Tensor

from ...episodes.observed import Episode
from ...identification.residuals.blocks import RESIDUAL_BLOCKS
from ..data.binning import BIN_SECONDS, FORCE_BLOCK
from ..decide.criteria import CRITERIA
from ..inference.fitting import ModelFit, posterior_precision

EPISODE_WINDOW_SPACING = 1000  # between the window numbers of two episodes


def localise_cause(
    fitted: ModelFit,
    name: str,
    motions: Sequence[str],
    episodes: Sequence[Episode],
    gaining_motions: Collection[str] = (),
) -> dict[str, Any]:
    """Return the place and the time window in which an accepted cause is most significant, and its effect there.

    Positions are used unless forces carry nearly all information, and of them the most informative kind of data.

    Args:
        fitted: a model with the cause.
        name: name of the cause.
        motions: label of each episode.
        episodes: those that the model was fitted to.
        gaining_motions: motions that the causes predict better, held out. Others are left out, unless there is none.

    Returns:
        "where": {"at": [u, v] on the pattern [m]} or {"gripper": name}; "when": {"episode", "motion", "from", "to"}
        [s from the first frame]; "response": {"value", "unit"} there, at the fitted amplitude.
    """
    all_bins = fitted.linearisation.bins
    response = torch.cat(_compute_response(fitted, name))
    scatter = torch.cat([_bin_std(fitted, k) for k in range(len(all_bins))])
    information = (response / scatter).square()
    block, window, part, position = (
        torch.cat(columns)
        for columns in zip(*((b.block, b.window, b.channel // 3, b.rest_position) for b in all_bins), strict=True)
    )
    episode = torch.cat([torch.full_like(b.block, k) for k, b in enumerate(all_bins)])
    selected = block < FORCE_BLOCK
    has_positions = information[selected].sum() > CRITERIA.report.min_position_information * information.sum()
    selected = selected if has_positions else ~selected
    gains = torch.tensor([motion in gaining_motions for motion in motions])[episode]
    selected = selected & gains if (selected & gains).any() else selected
    for column in (block, episode * EPISODE_WINDOW_SPACING + window, part):
        selected = selected & (column == _most_informative(column, information, selected))
    first = int(selected.nonzero()[0])
    k, w, kind = int(episode[first]), int(window[first]), int(block[first])
    if kind >= FORCE_BLOCK:
        where: dict[str, Any] = {"gripper": list(episodes[k].wrenches)[int(part[first])]}
    else:
        where = {"at": position[first, :2].tolist()}
    start, end = round(w * BIN_SECONDS, 9), round((w + 1) * BIN_SECONDS, 9)
    return {
        "where": where,
        "when": {"episode": k, "motion": motions[k], "from": start, "to": end},
        "response": {"value": float(response[selected].norm()), "unit": RESIDUAL_BLOCKS[kind].unit},
    }


def _compute_response(fitted: ModelFit, name: str) -> list[Tensor]:
    """Return per episode [B] the cause at its amplitude, less what other fitted coordinates could do instead."""
    model, square = fitted.model, posterior_precision(fitted.whitened, fitted.model)
    column = len(model.parameters) + model.index_of(name)
    others = [k for k in range(fitted.linearisation.n_coordinates) if k != column]
    compensation = torch.linalg.solve(square[others][:, others], square[others, column])
    amplitude = model.amplitudes[model.index_of(name)]
    return [
        amplitude * (bins.jacobian[:, column] - bins.jacobian[:, others] @ compensation)
        for bins in fitted.linearisation.bins
    ]


def _bin_std(fitted: ModelFit, k: int) -> Tensor:
    """Return [B] standard deviations of an episode's bins, including roughness."""
    bins = fitted.linearisation.bins[k]
    return (fitted.noise.smooth_variance(bins) / fitted.noise.smooth_fraction(bins)).sqrt()


def _most_informative(column: Tensor, information: Tensor, selected: Tensor) -> int:
    """Return the entry of a column [B] whose selected bins carry most information together."""
    entries, index = column[selected].unique(return_inverse=True)
    totals = torch.zeros(len(entries)).to(information).index_add(0, index, information[selected])
    return int(entries[totals.argmax()])
