"""Which hypotheses the residuals speak for: efficient scores against the smallest amplitude of interest.

With J_n the slopes along everything that is fitted anyway and J_j those along hypothesis j, both whitened,

    S_j = J_j' (M r - J_n (J_n' J_n + P)^-1 P t),  V_j = J_j' M J_j,  M = 1 - J_n (J_n' J_n + P)^-1 J_n'

where t is how far what is fitted lies from the middle of its priors P,

EPC_j = -S_j / V_j is the amplitude that the residuals ask for, S_j^2 / V_j what chi^2 would gain (Saris, Satorra and
van der Veld 2009; Neyman's C(alpha)). Slopes are finite ones, at typical amplitudes: tangents at zero miss effects that
begin slowly.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from torch import Tensor

from ...episodes.world import Hypothesis
from ..data.binning import FORCE_BLOCK
from .fitting import ModelFit, posterior_precision, robust_step, robust_step_with, prior_precision
from .linearise import FINE_MESH_ERROR_FRACTION

Decision = Literal["present", "absent", "inconclusive", "unresolvable"]
PRESENT = 2.5  # standard errors above the smallest amplitude of interest
LEAST = 3e-4  # m: a typical amplitude that moves less cannot be seen
LEAST_PULL = 1e-2  # N, the same of forces
MUCH = 8.0  # log density, of a cause that is worth fitting
PULLED = 3.0  # standard deviations of its prior, from which a parameter does what its twin is asked about
POWER = 1.64 + 0.84  # standard errors: told from nothing in 80 % of cases at 5 %; PRESENT asks for as many: in a half


class ScoreTest(NamedTuple):
    """What the data say of one hypothesis."""

    hypothesis: Hypothesis
    amplitude: float  # that the residuals ask for
    std: float  # from the noise
    mesh_bias: float  # that numerics alone would ask for
    chi2: float  # chi^2
    position_rms: (
        float  # m, RMS by which a typical amplitude moves points beside what is fitted, in the episode that tells most
    )
    force_rms: float  # N, the same of forces
    step_amplitude: float  # amplitude where a leap leads (``fitting.leap_with``)
    expected_gain: float  # log density that it should gain
    decision: Decision

    @property
    def total_std(self) -> float:
        """Standard error with numerics."""
        return (self.std**2 + self.mesh_bias**2) ** 0.5

    @property
    def smallest_detectable(self) -> float:
        """Smallest amplitude that these data would show, in every other case."""
        return abs(self.hypothesis.smallest) + POWER * self.total_std

    @property
    def z_above_smallest(self) -> float:
        """Standard errors by which the amplitude exceeds the smallest of interest."""
        return (self.admissible_amplitude - abs(self.hypothesis.smallest)) / self.total_std

    @property
    def is_visible(self) -> bool:
        """What is asked for would show, even where a typical amplitude would not."""
        return self.visibility * self._forward(self.step_amplitude) > abs(self.hypothesis.typical)

    @property
    def visibility(self) -> float:
        """A typical amplitude's effect on points or forces, over the least that shows."""
        return max(self.position_rms / LEAST, self.force_rms / LEAST_PULL)

    @property
    def has_wrong_sign(self) -> bool:
        """Absent because what is asked for would matter, but for its sign, which makes no sense."""
        return self.decision == "absent" and self.admissible_amplitude < -abs(self.hypothesis.smallest)

    @property
    def admissible_amplitude(self) -> float:
        """The amplitude; negative where it would need a sign that makes no sense."""
        return self._forward(self.amplitude)

    def _forward(self, amplitude: float) -> float:
        return abs(amplitude) if self.hypothesis.signed else amplitude


def screen(found: ModelFit) -> list[ScoreTest]:
    """One row for each hypothesis that was asked about, the largest gain first."""
    own = found.linearisation.n_coordinates
    projected = build_projection(found)
    asked = projected(found.whitened.jacobian[:, own:])
    value, numerics = projected(found.whitened.value, found.model.point), projected(_numerics(found))
    sizes, pulls = _sizes(found)
    further, alone = robust_step(found.whitened, found.model)
    rows, fitted = [], [p.name for p in found.model.parameters]
    for j, h in enumerate(found.linearisation.hypotheses):
        information = float(asked[:, j] @ asked[:, j])
        as_fitted = h.equivalent_parameter in fitted and not _pulled(found, further, fitted.index(h.equivalent_parameter))
        if as_fitted or information < 1e-12 / h.typical**2:
            rows.append(ScoreTest(h, 0.0, float("inf"), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, "unresolvable"))
            continue
        amplitude = -float(asked[:, j] @ value) / information
        bias = -float(asked[:, j] @ numerics) / information
        step, gained = robust_step_with(found.whitened, found.model.plus(h), own + j)
        more = (float(sizes[j]), float(pulls[j]), float(step[-1]), gained - alone)
        row = ScoreTest(h, amplitude, information**-0.5, bias, amplitude**2 * information, *more, "absent")
        rows.append(row._replace(decision=_decided(row)))
    return sorted(rows, key=lambda row: -row.chi2)


def _pulled(found: ModelFit, further: Tensor, index: int) -> bool:
    """Data and data sheet disagree about a parameter: beside it, only its prior tells of what does the same.

    ``further`` is the step that leads from where the fit ended to the optimum. A mean of both lies
    sqrt(prior variance - its own) from the sheet where they agree.
    """
    away, std = float(found.model.values[index] + further[index]), found.model.parameters[index].std
    return away**2 > PULLED**2 * max(std**2 - float(found.covariance[index, index]), 0.0)


def build_projection(found: ModelFit):
    """M as a function of columns: what is left of them beside all that is fitted anyway, with its priors.

    Residuals have a second argument: where what is fitted lies, which its priors pull back from.
    """
    prior = prior_precision(found.model).sqrt()
    own = torch.cat([found.whitened.jacobian[:, : found.linearisation.n_coordinates], torch.diag(prior)])
    basis, _ = torch.linalg.qr(own)
    rows = len(found.whitened.value)

    def left(columns: Tensor, point: Tensor | None = None) -> Tensor:
        wide = columns[:, None] if columns.ndim == 1 else columns
        pulled = wide.new_zeros(len(prior), wide.shape[1]) if point is None else (prior * point)[:, None]
        padded = torch.cat([wide, pulled])
        out = padded - basis @ (basis.mT @ padded)
        return out[:, 0] if columns.ndim == 1 else out

    if rows + len(prior) != len(own):
        raise ValueError("rows of slopes and residuals differ")
    return left


def _decided(row: ScoreTest) -> Decision:
    if row.is_visible and row.z_above_smallest > PRESENT:
        return "present"
    if row.visibility < 1.0 or row.smallest_detectable > 1.0 * abs(row.hypothesis.typical) + abs(row.hypothesis.smallest):
        return "unresolvable"
    if row.z_above_smallest > PRESENT:
        return "present"
    less = row.admissible_amplitude + 1.64 * row.total_std < abs(row.hypothesis.smallest)
    leads = row.expected_gain > MUCH and row._forward(row.step_amplitude) > abs(row.hypothesis.smallest)  # slopes ask for too little
    return "absent" if less and not leads else "inconclusive"


def _numerics(found: ModelFit) -> Tensor:
    parts = [
        torch.linalg.solve_triangular(root, FINE_MESH_ERROR_FRACTION * n[:, None], upper=False)[:, 0]
        for root, n in zip(found.whitened.cholesky_factors, found.linearisation.mesh_differences, strict=True)
    ]
    return found.whitened.row_weight * torch.cat(parts)


def _sizes(found: ModelFit) -> Tensor:
    """[2, hypotheses] RMS in m of positions and in N of forces, in the episode where that is most; zero without any.

    Ripples count for less. Beside what is fitted anyway, as far as its priors let it do the same; of a twin, beside the
    other parameters.
    """
    own, count = found.linearisation.n_coordinates, len(found.linearisation.hypotheses)
    typical = torch.tensor([h.typical for h in found.linearisation.hypotheses], dtype=torch.float64)
    slopes, names = found.whitened.jacobian, [p.name for p in found.model.parameters]
    square, cross = posterior_precision(found.whitened, found.model), slopes[:, :own].mT @ slopes[:, own:]
    fitted = torch.linalg.solve(square, cross)
    for j, h in enumerate(found.linearisation.hypotheses):
        if h.equivalent_parameter in names:
            others = [k for k in range(own) if k != names.index(h.equivalent_parameter)]
            fitted[:, j] = 0.0
            fitted[others, j] = torch.linalg.solve(square[others][:, others], cross[others, j])
    largest = typical.new_zeros(2, count)
    for cells in found.linearisation.bins:
        moved = (cells.jacobian[:, own : own + count] - cells.jacobian[:, :own] @ fitted) * typical
        share = found.noise.smooth_fraction(cells) * torch.stack([cells.block < FORCE_BLOCK, cells.block == FORCE_BLOCK])
        counted = share.sum(1, keepdim=True)
        largest = torch.maximum(largest, (share @ moved.square() / counted.clamp(min=1e-30)).sqrt())
    return largest * typical.new_tensor([[1.0], [3**0.5]])  # a force has three cells
