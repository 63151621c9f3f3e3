"""Lack of fit: residuals of a model compared with those of a correct model.

A correct model leaves residuals with covariance K = S + M M'. S holds white noise, roughness and slow errors of known
levels: the sensor's (``AdequacyCriteria.sensor_error``) and what the fine mesh leaves of the difference between both
meshes. M holds the nuisances and the uncertainty of the fitted coordinates. Of residuals r, S K^-1 r is left over. Its
mean square is compared with the expected one, tr(S K^-1 S) / n, for every motion and kind of data. For a correct model
the ratio follows a chi-squared distribution with the effective number of bins as degrees of freedom (Satterthwaite
1946). Two simulators never agree exactly, so a lack of fit must also have an RMS of 2.25 times the expected one. Where
the two meshes fold the cloth in different ways nothing can be judged.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from scipy.special import chdtrc
from torch import Tensor

from ..data.binning import BIN_SECONDS, BLOCK_NAMES, FORCE_BLOCK, BinnedResiduals
from ..decide.criteria import CRITERIA
from .fitting import ModelFit
from .linearise import FINE_MESH_ERROR_FRACTION
from .noise import Noise


class LackOfFit(NamedTuple):
    """Test of one kind of data in one motion.

    Attributes:
        episode: index of the episode.
        motion: label of its motion.
        kind: kind of data.
        unit: unit of the RMS.
        rms: RMS of the bins, without what nuisances and uncertain coordinates explain.
        expected_rms: RMS that a correct model leaves.
        mesh_rms: part of ``expected_rms`` that the fine mesh leaves of the difference between both meshes.
        effective_bins: effective number of independent bins.
        p_value: probability that a correct model leaves as much.
        meshes_agree: whether both meshes fold the cloth in the same way.
        by_window: contributions to ``rms`` squared and ``expected_rms`` squared by time window.
    """

    episode: int
    motion: str
    kind: str
    unit: str
    rms: float
    expected_rms: float
    mesh_rms: float
    effective_bins: float
    p_value: float
    meshes_agree: bool
    by_window: Mapping[int, tuple[float, float]]

    @property
    def is_position(self) -> bool:
        """Whether the data are positions and not forces or torques."""
        return self.unit == "m"

    @property
    def rms_ratio(self) -> float:
        """RMS over the expected RMS."""
        return self.rms / self.expected_rms

    @property
    def is_significant(self) -> bool:
        """Whether the residuals are larger than those of a correct model."""
        criteria = CRITERIA.adequacy
        return self.meshes_agree and self.rms_ratio > criteria.max_rms_ratio and self.p_value < criteria.max_p_value

    def as_dict(self) -> dict[str, Any]:
        """Return the row of diagnosis.json."""
        row = {key: value for key, value in self._asdict().items() if key != "by_window"}
        return {
            **row,
            "rms_ratio": self.rms_ratio,
            "is_significant": self.is_significant,
            "worst_window": self._worst_window(),
        }

    def _worst_window(self) -> dict[str, float] | None:
        """Return the window with the largest excess, and the ratio of all others; None with few windows."""
        if len(self.by_window) < CRITERIA.adequacy.min_windows:
            return None
        worst = max(self.by_window, key=lambda w: self.by_window[w][0] - self.by_window[w][1])
        square, expected = (sum(row[i] for w, row in self.by_window.items() if w != worst) for i in (0, 1))
        return {
            "from": round(worst * BIN_SECONDS, 9),
            "to": round((worst + 1) * BIN_SECONDS, 9),
            "ratio_elsewhere": (square / expected) ** 0.5,
        }


def measure_lack_of_fit(fitted: ModelFit, motions: Sequence[str]) -> list[LackOfFit]:
    """Test each kind of data in each episode; ``motions`` labels the episodes."""
    return [row for k, motion in enumerate(motions) for row in _test_episode(fitted, k, motion)]


def has_lack_of_fit(fitted: ModelFit, motions: Sequence[str]) -> bool:
    """Check whether any kind of data in any motion has a significant lack of fit."""
    return any(row.is_significant for row in measure_lack_of_fit(fitted, motions))


def compare_misfit(before: Sequence[LackOfFit], after: Sequence[LackOfFit]) -> float:
    """Return the fraction of the misfit of points, edges and markers that is removed; 1 if there was none.

    The misfit is the mean square beyond the expected one. Forces and torques count instead if that is more and
    positions have no significant lack of fit, before or after.
    """
    fraction = _fraction_removed(before, after, positions=True)
    if any(row.is_position and row.is_significant for row in (*before, *after)):
        return fraction
    return max(fraction, _fraction_removed(before, after, positions=False))


def _fraction_removed(before: Sequence[LackOfFit], after: Sequence[LackOfFit], positions: bool) -> float:
    """Return that fraction for positions in m^2, or for forces and torques in units of the expected mean square.

    Motions with less than the expected residuals do not make up for others. If the meshes disagree before or after, a
    motion does not count on either side: what vacuum folds away would come back as if a cause had caused it.
    """
    unjudged = {(row.episode, row.kind) for row in (*before, *after) if not row.meshes_agree}

    def excess(rows: Sequence[LackOfFit]) -> float:
        judged = [r for r in rows if r.is_position is positions and (r.episode, r.kind) not in unjudged]
        return sum(max(0.0, r.rms**2 - r.expected_rms**2) / (1.0 if positions else r.expected_rms**2) for r in judged)

    first, last = excess(before), excess(after)
    return 1.0 - last / first if first > 0 else float(last == 0)


def _test_episode(fitted: ModelFit, k: int, motion: str) -> list[LackOfFit]:
    bins = fitted.linearisation.bins[k]
    noise_covariance, uncertain = expected_covariance(fitted, k)
    _, mesh_levels = reference_noise(bins, fitted.linearisation.mesh_differences[k])
    meshes_agree = _is_below_fold(mesh_levels)
    gain = torch.linalg.solve(noise_covariance + uncertain @ uncertain.mT, noise_covariance).mT  # S K^-1
    left, covariance = gain @ bins.value, gain @ noise_covariance
    rows = []
    for b in bins.block.unique().tolist():
        is_block = bins.block == b
        block_covariance = covariance[is_block][:, is_block]
        count, total = int(is_block.sum()), float(block_covariance.trace())
        effective = total**2 / float(block_covariance.square().sum())
        square = float(left[is_block].square().sum())
        by_window = {
            w: (
                float(left[in_window].square().sum()) / count,
                float(covariance.diagonal()[in_window].sum()) / count,
            )
            for w in bins.window[is_block].unique().tolist()
            for in_window in [is_block & (bins.window == w)]
        }
        rows.append(
            LackOfFit(
                episode=k,
                motion=motion,
                kind=BLOCK_NAMES[b],
                unit="m" if b < FORCE_BLOCK else "N" if BLOCK_NAMES[b] == "force" else "N m",
                rms=(square / count) ** 0.5,
                expected_rms=(total / count) ** 0.5,
                mesh_rms=float(mesh_levels[b]),
                effective_bins=effective,
                p_value=float(chdtrc(effective, effective * square / total)),
                meshes_agree=meshes_agree,
                by_window=by_window,
            )
        )
    return rows


def do_meshes_agree(fitted: ModelFit, k: int) -> bool:
    """Check whether both meshes fold the cloth of the k-th episode in the same way."""
    return _is_below_fold(reference_noise(fitted.linearisation.bins[k], fitted.linearisation.mesh_differences[k])[1])


def _is_below_fold(mesh_levels: Tensor) -> bool:
    return float(mesh_levels[:FORCE_BLOCK].max()) < CRITERIA.adequacy.max_mesh_disagreement_m


def expected_covariance(fitted: ModelFit, k: int) -> tuple[Tensor, Tensor]:
    """Return (S [B, B], M [B, N]) of the k-th episode for a correct model."""
    bins, nuisance_stds = fitted.linearisation.bins[k], fitted.linearisation.nuisance_stds[k]
    n_coordinates = fitted.linearisation.n_coordinates
    by_coordinates = bins.jacobian[:, :n_coordinates] @ torch.linalg.cholesky(fitted.covariance)
    uncertain = torch.cat([by_coordinates, bins.jacobian[:, -len(nuisance_stds) :] * nuisance_stds], 1)
    noise, _ = reference_noise(bins, fitted.linearisation.mesh_differences[k])
    return noise.covariance(bins, uncertain[:, :0], uncertain.new_zeros(0)), uncertain


def reference_noise(bins: BinnedResiduals, mesh_difference: Tensor) -> tuple[Noise, Tensor]:
    """Return the slow errors of a correct model, and those of the mesh alone.

    Args:
        bins: of one episode.
        mesh_difference: [B] residual on the coarse mesh minus residual on the fine mesh.

    Returns:
        The noise, and [blocks] the levels of what the fine mesh leaves of the difference.
    """
    mesh_levels = torch.zeros(len(BLOCK_NAMES), dtype=bins.value.dtype)
    for b in bins.block.unique().tolist():
        mesh_levels[b] = FINE_MESH_ERROR_FRACTION * mesh_difference[bins.block == b].square().mean().sqrt()
    sensor = torch.tensor([CRITERIA.adequacy.sensor_error[name] for name in BLOCK_NAMES], dtype=mesh_levels.dtype)
    return Noise((sensor**2 + mesh_levels**2).sqrt()), mesh_levels
