"""Pieces of a cloud's rim that lie beside the cloth's by different distances, for a whole episode.

The offset of one piece is shared by its rows in all frames. It is marginalised: the rows' mean loses the share b, and
so does that of their slopes, with 1 - b = (1 + n s^2 / e^2)^(-1/2) for n rows of noise e and offsets of standard
deviation s. What is left has the weighted squares of generalised least squares.
"""

from __future__ import annotations

import torch

from ..residuals.rows import ResidualRows

ROW_NOISE_M = 2e-3  # of one piece in one frame: cameras of 1 to 3 mm show ends to 1 to 3 mm


def marginalise_piece_offsets(rows: ResidualRows, std: float) -> ResidualRows:
    """Return rows of one episode whose pieces have offsets of standard deviation ``std`` [m].

    Rows of pieces that were not seen are 0 and stay so.
    """
    piece = torch.unique(rows.error_group, return_inverse=True)[1]
    is_seen = rows.residual != 0
    count = torch.zeros(int(piece.max()) + 1, dtype=rows.residual.dtype).index_add(0, piece, is_seen.to(rows.residual))
    share = 1 - (1 + count * std**2 / ROW_NOISE_M**2) ** -0.5

    def take_mean(values: torch.Tensor) -> torch.Tensor:
        seen = values * is_seen[:, None]
        mean = values.new_zeros(len(count), values.shape[1]).index_add(0, piece, seen) / count.clamp(min=1)[:, None]
        return seen - is_seen[:, None] * (share[:, None] * mean)[piece]

    residual = take_mean(rows.residual[:, None])[:, 0]
    jacobian = None if rows.jacobian is None else take_mean(rows.jacobian)
    return rows._replace(residual=residual, jacobian=jacobian)
