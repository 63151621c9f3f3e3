"""Hypotheses that these data cannot tell from each other.

D_ij = a_i^2 V_ii (1 - rho_ij^2) is the chi^2 by which i at amplitude a_i can be told from j at its best amplitude, by
slopes; of two that were fitted it is the square of what lies between the two models.
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from .fitting import ModelFit, reweight_by_noise
from .linearise import restrict_to_common_bins
from .noise import Noise
from .robust_weights import remove_weights
from .screening import ScoreTest, build_projection

TOLD = 9.0  # chi^2, three standard deviations
ALIKE = 0.99  # correlation


def correlate_scores(found: ModelFit) -> Tensor:
    """[hypotheses, hypotheses] of the efficient scores."""
    asked = build_projection(found)(found.whitened.jacobian[:, found.linearisation.n_coordinates :])
    norm = asked.norm(dim=0).clamp(min=1e-12)
    return (asked.mT @ asked) / (norm[:, None] * norm)


def find_confounded(found: ModelFit, row: ScoreTest, amplitude: float, others: Sequence[ScoreTest]) -> list[ScoreTest]:
    """Those of ``others`` that cannot be told from ``row`` at this amplitude or the one that was asked for.

    Directions of the same effect are none, nor is what would have to have a sign that it cannot have. Where slopes ask
    for one the other way round, its amplitude is what would stand in for the cause.
    """
    if not others:
        return []
    index = {h.name: k for k, h in enumerate(found.linearisation.hypotheses)}
    if row.hypothesis.name not in index:  # no world could have it there
        return []
    rho = correlate_scores(found)[index[row.hypothesis.name]]
    square = max(row.chi2, (amplitude / row.std) ** 2)
    out = []
    for other in others:
        r = float(rho[index[other.hypothesis.name]])
        if not other.hypothesis.signed and r * amplitude < 0:
            continue
        told = square * (1 - r * r)
        if other.hypothesis.effect != row.hypothesis.effect and (abs(r) > ALIKE or told < TOLD):
            instead = r * amplitude * other.std / row.std
            out.append(other if other.amplitude * instead >= 0 else other._replace(amplitude=instead))
    return out


def are_fits_confounded(one: ModelFit, other: ModelFit, noise: Noise) -> bool:
    """Two models that cannot be told from each other where either was fitted, whatever slopes said elsewhere."""
    like = restrict_to_common_bins(one.linearisation, [other.linearisation])
    mine, others = (remove_weights(reweight_by_noise(found, noise, like).whitened).value for found in (one, other))
    return float((mine - others).square().sum()) < TOLD
