"""Hypotheses that the data cannot distinguish.

D_ij = a_i^2 V_ii (1 - rho_ij^2) is the linearised chi-squared that distinguishes hypothesis i at amplitude a_i from
hypothesis j at its best amplitude. For two fitted models it is the squared distance of their whitened residuals.
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from ..decide.criteria import CRITERIA
from .fitting import ModelFit, reweight_by_noise
from .linearise import restrict_to_common_bins
from .noise import Noise
from .robust_weights import remove_weights
from .screening import ScoreTest, build_projection


def correlate_scores(fitted: ModelFit) -> Tensor:
    """Return [hypotheses, hypotheses] the correlations of the efficient scores."""
    slopes = build_projection(fitted)(fitted.whitened.jacobian[:, fitted.linearisation.n_coordinates :])
    norm = slopes.norm(dim=0).clamp(min=1e-12)
    return (slopes.mT @ slopes) / (norm[:, None] * norm)


def find_confounded(
    fitted: ModelFit, score: ScoreTest, amplitude: float, others: Sequence[ScoreTest]
) -> list[ScoreTest]:
    """Return the hypotheses that cannot be distinguished from one hypothesis, linearised.

    Directions of the same effect do not count, nor does a hypothesis that would need a sign that it cannot have. If the
    slopes ask for another one with the opposite sign, its amplitude is the one that would take the place of the first.

    Args:
        fitted: the model without the hypothesis.
        score: score test of the hypothesis.
        amplitude: its fitted amplitude; the larger of this and the one that was asked for counts.
        others: score tests of the hypotheses to compare with.
    """
    if not others:
        return []
    index = {h.name: k for k, h in enumerate(fitted.linearisation.hypotheses)}
    if score.hypothesis.name not in index:  # it could not be simulated there
        return []
    criteria = CRITERIA.confounding
    correlation = correlate_scores(fitted)[index[score.hypothesis.name]]
    chi2 = max(score.chi2, (amplitude / score.std) ** 2)
    confounded = []
    for other in others:
        rho = float(correlation[index[other.hypothesis.name]])
        if not other.hypothesis.signed and rho * amplitude < 0:
            continue
        is_confounded = abs(rho) > criteria.min_correlation or chi2 * (1 - rho * rho) < criteria.max_chi2
        if other.hypothesis.effect != score.hypothesis.effect and is_confounded:
            substitute = rho * amplitude * other.std / score.std
            confounded.append(other if other.amplitude * substitute >= 0 else other._replace(amplitude=substitute))
    return confounded


def are_fits_confounded(one: ModelFit, other: ModelFit, noise: Noise) -> bool:
    """Check whether two fitted models cannot be distinguished, whatever the slopes say elsewhere."""
    common = restrict_to_common_bins(one.linearisation, [other.linearisation])
    first, second = (remove_weights(reweight_by_noise(fitted, noise, common).whitened).value for fitted in (one, other))
    return float((first - second).square().sum()) < CRITERIA.confounding.max_chi2
