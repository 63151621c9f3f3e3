"""Score tests: which hypotheses the residuals ask for, compared with the smallest effect of interest.

With the whitened slopes J_n along everything that is fitted anyway, and J_j along hypothesis j,

    S_j = J_j' (M r - J_n (J_n' J_n + P)^-1 P t),  V_j = J_j' M J_j,  M = 1 - J_n (J_n' J_n + P)^-1 J_n'

where t is the distance of the fitted coordinates from the mean of their priors, with precision P. The expected
parameter change -S_j / V_j is the amplitude that the residuals ask for, and S_j^2 / V_j is the gain in chi-squared
(Saris, Satorra and van der Veld 2009; Neyman's C(alpha)). Slopes are finite ones, at typical amplitudes: tangents at
zero miss effects that begin slowly.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from ...episodes.world import Hypothesis
from ..data.binning import FORCE_BLOCK
from ..decide.criteria import CRITERIA
from .comparison import FORCE_NORM_FACTOR
from .fitting import ModelFit, posterior_precision, prior_precision, robust_step, robust_step_with
from .linearise import FINE_MESH_ERROR_FRACTION

Decision = Literal["present", "absent", "inconclusive", "unresolvable"]
MIN_RELATIVE_INFORMATION = 1e-12  # of a typical amplitude, below which a hypothesis does nothing


class ScoreTest(NamedTuple):
    """Score test of one hypothesis.

    Attributes:
        hypothesis: the hypothesis.
        amplitude: amplitude that the residuals ask for.
        std: its standard error by noise.
        mesh_bias: amplitude that the difference of the meshes alone would ask for.
        chi2: gain in chi-squared.
        position_rms: RMS by which a typical amplitude moves points beyond what is fitted anyway, in the most
            informative episode [m].
        force_rms: the same of forces [N].
        step_amplitude: amplitude where a robust step leads (``fitting.robust_step_with``).
        expected_gain: log density that this step should gain.
        decision: result of the test.
    """

    hypothesis: Hypothesis
    amplitude: float
    std: float
    mesh_bias: float
    chi2: float
    position_rms: float
    force_rms: float
    step_amplitude: float
    expected_gain: float
    decision: Decision

    @property
    def total_std(self) -> float:
        """Standard error by noise and mesh."""
        return (self.std**2 + self.mesh_bias**2) ** 0.5

    @property
    def smallest_detectable(self) -> float:
        """Smallest amplitude that these data would show in every other case."""
        return abs(self.hypothesis.smallest_of_interest) + CRITERIA.screening.detection_z * self.total_std

    @property
    def z_above_smallest(self) -> float:
        """Standard errors by which the amplitude exceeds the smallest one of interest."""
        return (self.admissible_amplitude - abs(self.hypothesis.smallest_of_interest)) / self.total_std

    @property
    def is_visible(self) -> bool:
        """Whether the amplitude that is asked for would show, even if a typical one would not."""
        return self.visibility * self._admissible(self.step_amplitude) > abs(self.hypothesis.typical)

    @property
    def visibility(self) -> float:
        """Effect of a typical amplitude on points or forces, over the smallest visible one."""
        criteria = CRITERIA.screening
        return max(
            self.position_rms / criteria.min_visible_displacement_m, self.force_rms / criteria.min_visible_force_n
        )

    @property
    def has_wrong_sign(self) -> bool:
        """Whether the hypothesis is absent only because the relevant amplitude that is asked for has a wrong sign."""
        return self.decision == "absent" and self.admissible_amplitude < -abs(self.hypothesis.smallest_of_interest)

    @property
    def admissible_amplitude(self) -> float:
        """Size of the amplitude; negative if it has a sign that makes no sense."""
        return self._admissible(self.amplitude)

    def _admissible(self, amplitude: float) -> float:
        return abs(amplitude) if self.hypothesis.signed else amplitude


def screen(fitted: ModelFit) -> list[ScoreTest]:
    """Test every hypothesis that the fit was asked about; the largest gain comes first."""
    n_coordinates = fitted.linearisation.n_coordinates
    project = build_projection(fitted)
    slopes = project(fitted.whitened.jacobian[:, n_coordinates:])
    value, mesh_value = project(fitted.whitened.value, fitted.model.point), project(_whiten_mesh_error(fitted))
    position_rms, force_rms = _typical_effects(fitted)
    step, gain_without = robust_step(fitted.whitened, fitted.model)
    scores, parameters = [], [p.name for p in fitted.model.parameters]
    for j, h in enumerate(fitted.linearisation.hypotheses):
        information = float(slopes[:, j] @ slopes[:, j])
        is_fitted_already = h.equivalent_parameter in parameters and not _has_prior_conflict(
            fitted, step, parameters.index(h.equivalent_parameter)
        )
        if is_fitted_already or information < MIN_RELATIVE_INFORMATION / h.typical**2:
            scores.append(ScoreTest(h, 0.0, float("inf"), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, "unresolvable"))
            continue
        amplitude = -float(slopes[:, j] @ value) / information
        extended = fitted.model.with_hypothesis(h)
        step_with, gain_with = robust_step_with(fitted.whitened, extended, n_coordinates + j)
        score = ScoreTest(
            hypothesis=h,
            amplitude=amplitude,
            std=information**-0.5,
            mesh_bias=-float(slopes[:, j] @ mesh_value) / information,
            chi2=amplitude**2 * information,
            position_rms=float(position_rms[j]),
            force_rms=float(force_rms[j]),
            step_amplitude=float(step_with[-1]),
            expected_gain=gain_with - gain_without,
            decision="absent",
        )
        scores.append(score._replace(decision=_decide(score)))
    return sorted(scores, key=lambda score: -score.chi2)


def _has_prior_conflict(fitted: ModelFit, step: Tensor, index: int) -> bool:
    """Whether data and data sheet disagree about a parameter.

    Beside such a parameter only its prior distinguishes it from an equivalent hypothesis. ``step`` leads from the end
    of the fit to the optimum. If data and data sheet agree, a mean of both lies sqrt(prior variance - its own) from the
    data sheet.
    """
    shift, std = float(fitted.model.coordinates[index] + step[index]), fitted.model.parameters[index].prior_std
    expected_square = max(std**2 - float(fitted.covariance[index, index]), 0.0)
    return shift**2 > CRITERIA.screening.prior_conflict_stds**2 * expected_square


def build_projection(fitted: ModelFit) -> Callable[..., Tensor]:
    """Return M as a function of columns: what is left of them beyond all that is fitted anyway, with its priors.

    The function has a second argument for residuals: the fitted coordinates, which their priors pull back.
    """
    prior = prior_precision(fitted.model).sqrt()
    slopes = fitted.whitened.jacobian[:, : fitted.linearisation.n_coordinates]
    basis, _ = torch.linalg.qr(torch.cat([slopes, torch.diag(prior)]))
    if len(fitted.whitened.value) != len(slopes):
        raise ValueError("rows of slopes and residuals differ")

    def project(columns: Tensor, point: Tensor | None = None) -> Tensor:
        wide = columns[:, None] if columns.ndim == 1 else columns
        pulled = wide.new_zeros(len(prior), wide.shape[1]) if point is None else (prior * point)[:, None]
        padded = torch.cat([wide, pulled])
        out = padded - basis @ (basis.mT @ padded)
        return out[:, 0] if columns.ndim == 1 else out

    return project


def _decide(score: ScoreTest) -> Decision:
    criteria, smallest = CRITERIA.screening, abs(score.hypothesis.smallest_of_interest)
    is_significant = score.z_above_smallest > criteria.min_z_above_smallest
    if score.is_visible and is_significant:
        return "present"
    if score.visibility < 1.0 or score.smallest_detectable > abs(score.hypothesis.typical) + smallest:
        return "unresolvable"
    if is_significant:
        return "present"
    is_smaller = score.admissible_amplitude + criteria.absence_z * score.total_std < smallest
    # slopes ask for too little where a robust step leads to a relevant amplitude
    is_promising = (
        score.expected_gain > criteria.min_expected_gain and score._admissible(score.step_amplitude) > smallest
    )
    return "absent" if is_smaller and not is_promising else "inconclusive"


def _whiten_mesh_error(fitted: ModelFit) -> Tensor:
    parts = [
        torch.linalg.solve_triangular(factor, FINE_MESH_ERROR_FRACTION * difference[:, None], upper=False)[:, 0]
        for factor, difference in zip(
            fitted.whitened.cholesky_factors, fitted.linearisation.mesh_differences, strict=True
        )
    ]
    return fitted.whitened.row_weight * torch.cat(parts)


def _typical_effects(fitted: ModelFit) -> Tensor:
    """Return [2, hypotheses] RMS of positions [m] and of forces [N] that a typical amplitude moves.

    It is that of the episode where it is largest, with small weights for ripples, and zero without such data. What is
    fitted anyway does the same as far as its priors allow. For a hypothesis that equals a parameter, the other
    parameters do.
    """
    n, count = fitted.linearisation.n_coordinates, len(fitted.linearisation.hypotheses)
    typical = torch.tensor([h.typical for h in fitted.linearisation.hypotheses], dtype=torch.float64)
    slopes, names = fitted.whitened.jacobian, [p.name for p in fitted.model.parameters]
    square, cross = posterior_precision(fitted.whitened, fitted.model), slopes[:, :n].mT @ slopes[:, n:]
    compensation = torch.linalg.solve(square, cross)
    for j, h in enumerate(fitted.linearisation.hypotheses):
        if h.equivalent_parameter in names:
            others = [k for k in range(n) if k != names.index(h.equivalent_parameter)]
            compensation[:, j] = 0.0
            compensation[others, j] = torch.linalg.solve(square[others][:, others], cross[others, j])
    largest = typical.new_zeros(2, count)
    for bins in fitted.linearisation.bins:
        moved = (bins.jacobian[:, n : n + count] - bins.jacobian[:, :n] @ compensation) * typical
        kinds = torch.stack([bins.block < FORCE_BLOCK, bins.block == FORCE_BLOCK])
        weight = fitted.noise.smooth_fraction(bins) * kinds
        total = weight.sum(1, keepdim=True)
        largest = torch.maximum(largest, (weight @ moved.square() / total.clamp(min=1e-30)).sqrt())
    return largest * typical.new_tensor([[1.0], [FORCE_NORM_FACTOR]])
