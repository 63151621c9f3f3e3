"""What remains when a search has ended, beside what a right model would leave.

A right model leaves K = S + M M', where S are white noise, roughness and slow errors of a level that is known
beforehand, the sensor's (``SENSOR``) and what the finer mesh leaves of the difference between both meshes, and M what
differs from episode to episode and what the fitted numbers are uncertain by. Of the cells r, S K^-1 r is left over. Its
mean square is held against the one to be expected, tr(S K^-1 S) / n, for every motion and kind of data. For a right
model the quotient follows a chi^2 with the effective number of cells for degrees of freedom (Satterthwaite 1946), which
says what cannot be chance. Two engines never agree exactly, so what counts as a lack of fit must also be ``TOLERATED``
times as large as expected. Where both meshes fold the cloth in different ways nothing can be judged.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..data.binning import BLOCK_NAMES, FORCE_BLOCK, BIN_SECONDS, BinnedResiduals
from .fitting import ModelFit
from .linearise import FINE_MESH_ERROR_FRACTION
from .noise import Noise

SENSOR = {"points": 5e-4, "edges": 8e-4, "markers": 3e-4, "force": 1e-2, "torque": 1.5e-3}  # m, N, N m: slow errors
TOLERATED = 2.25  # times the expected RMS
FOLDED = 3e-3  # m, that the finer mesh leaves of the difference: both meshes fold the cloth in different ways
RARE = 0.01  # probability of a right model's leaving more
FEW = 4  # stretches of time, of fewer none is the worst


class LackOfFit(NamedTuple):
    """One kind of data in one motion."""

    episode: int
    motion: str
    kind: str
    unit: str
    rms: float  # RMS of the cells, without what nuisances and uncertain parameters explain
    expected_rms: float  # the same of a right model
    mesh_rms: float  # share of ``expected`` that the finer mesh leaves of the difference between both
    effective_bins: float  # effective number of independent ones
    p_value: float  # of a right model's leaving as much
    meshes_agree: bool  # both meshes agree about the motion
    by_window: Mapping[int, tuple[float, float]]  # of time: shares of left^2 and expected^2, by window

    @property
    def is_position(self) -> bool:
        """A position and not a force."""
        return self.unit == "m"

    @property
    def rms_ratio(self) -> float:
        """Of what is left to what was to be expected."""
        return self.rms / self.expected_rms

    @property
    def is_significant(self) -> bool:
        """More than a right model would leave."""
        return self.meshes_agree and self.rms_ratio > TOLERATED and self.p_value < RARE

    def as_dict(self) -> dict[str, Any]:
        """As diagnosis.json has it."""
        row = {key: value for key, value in self._asdict().items() if key != "stretches"}
        return {**row, "ratio": self.rms_ratio, "lacking": self.is_significant, "worst": self._worst()}

    def _worst(self) -> dict[str, float] | None:
        """The stretch in which most is left beyond what is expected, and what the others leave; None of few."""
        if len(self.by_window) < FEW:
            return None
        window = max(self.by_window, key=lambda w: self.by_window[w][0] - self.by_window[w][1])
        left, expected = (sum(share[i] for w, share in self.by_window.items() if w != window) for i in (0, 1))
        return {
            "from": round(window * BIN_SECONDS, 9),
            "to": round((window + 1) * BIN_SECONDS, 9),
            "ratio_elsewhere": (left / expected) ** 0.5,
        }


def measure_lack_of_fit(found: ModelFit, names: Sequence[str]) -> list[LackOfFit]:
    """One row for each kind of data in each of the motions ``names``."""
    return [row for k, name in enumerate(names) for row in _episode(found, k, name)]


def has_lack_of_fit(found: ModelFit, names: Sequence[str]) -> bool:
    """Whether any kind of data in any motion is."""
    return any(row.is_significant for row in measure_lack_of_fit(found, names))


def compare_misfit(before: Sequence[LackOfFit], after: Sequence[LackOfFit]) -> float:
    """Share of what a right model would not leave of points, edges and markers that is gone; 1 of nothing.

    Of forces and torques, where that is more and positions lack nothing, before or after.
    """
    share = _gone(before, after, seen=True)
    if any(row.is_position and row.is_significant for row in (*before, *after)):
        return share
    return max(share, _gone(before, after, seen=False))


def _gone(before: Sequence[LackOfFit], after: Sequence[LackOfFit], seen: bool) -> float:
    """That share of positions in m^2, or of what is felt in units of what a right model leaves.

    Motions in which less is left than that make up for none in which it is more. Where both meshes do not agree, before
    or after, nothing is counted on either side: what vacuum folds away would come back as if a cause had brought it.
    """
    folded = {(row.episode, row.kind) for row in (*before, *after) if not row.meshes_agree}

    def over(rows: Sequence[LackOfFit]) -> float:
        judged = [r for r in rows if r.is_position is seen and (r.episode, r.kind) not in folded]
        return sum(max(0.0, r.rms**2 - r.expected_rms**2) / (1.0 if seen else r.expected_rms**2) for r in judged)

    first, last = over(before), over(after)
    return 1.0 - last / first if first > 0 else float(last == 0)


def _episode(found: ModelFit, k: int, name: str) -> list[LackOfFit]:
    cells = found.linearisation.bins[k]
    still, moved = expected_covariance(found, k)
    _, numerics = reference_noise(cells, found.linearisation.mesh_differences[k])
    stable = _is_stable(numerics)
    kept = torch.linalg.solve(still + moved @ moved.mT, still).mT  # S K^-1
    left, covariance = kept @ cells.value, kept @ still
    rows = []
    for b in cells.block.unique().tolist():
        here = cells.block == b
        own = covariance[here][:, here]
        count, total, squares = int(here.sum()), float(own.trace()), float(own.square().sum())
        freedom = total**2 / squares
        seen = float(left[here].square().sum())
        when = {
            w: (float(left[now].square().sum()) / count, float(covariance.diagonal()[now].sum()) / count)
            for w in cells.window[here].unique().tolist()
            for now in [here & (cells.window == w)]
        }
        rows.append(
            LackOfFit(
                k,
                name,
                BLOCK_NAMES[b],
                "m" if b < FORCE_BLOCK else "N" if BLOCK_NAMES[b] == "force" else "N m",
                (seen / count) ** 0.5,
                (total / count) ** 0.5,
                float(numerics[b]),
                freedom,
                float(torch.special.gammaincc(torch.tensor(freedom / 2), torch.tensor(freedom * seen / total / 2))),
                stable,
                when,
            )
        )
    return rows


def do_meshes_agree(found: ModelFit, k: int) -> bool:
    """Whether both meshes agree about the motion of one episode."""
    return _is_stable(reference_noise(found.linearisation.bins[k], found.linearisation.mesh_differences[k])[1])


def _is_stable(numerics: Tensor) -> bool:
    return float(numerics[:FORCE_BLOCK].max()) < FOLDED


def expected_covariance(found: ModelFit, k: int) -> tuple[Tensor, Tensor]:
    """(S [C, C], M [C, N]) of one episode by a right model."""
    cells, stds = found.linearisation.bins[k], found.linearisation.nuisance_stds[k]
    uncertain = cells.jacobian[:, : found.linearisation.n_coordinates] @ torch.linalg.cholesky(found.covariance)
    moved = torch.cat([uncertain, cells.jacobian[:, -len(stds) :] * stds], 1)
    level, _ = reference_noise(cells, found.linearisation.mesh_differences[k])
    return level.covariance(cells, moved[:, :0], moved.new_zeros(0)), moved


def reference_noise(cells: BinnedResiduals, difference: Tensor) -> tuple[Noise, Tensor]:
    """(slow errors of a right model, those of numerics alone [blocks]); ``difference`` [C] between both meshes."""
    numerics = torch.zeros(len(BLOCK_NAMES), dtype=cells.value.dtype)
    for b in cells.block.unique().tolist():
        numerics[b] = FINE_MESH_ERROR_FRACTION * difference[cells.block == b].square().mean().sqrt()
    sensor = torch.tensor([SENSOR[name] for name in BLOCK_NAMES], dtype=numerics.dtype)
    return Noise((sensor**2 + numerics**2).sqrt()), numerics
