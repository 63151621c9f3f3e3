"""Finished episodes on disk, so that a stopped diagnosis continues where it was.

The residuals of an episode at a point are a function of model, episode and question. A search is deterministic: run
again, it asks the same questions in the same order, and finds the earlier answers, bit by bit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from torch import Tensor

from .._utils.resume import ResumableStore, digest
from ..episodes.cloth_fingerprint import cloth_fingerprint_parts
from ..episodes.world import WorldModel
from .causes.user_hypotheses import digest_user_files
from .data.binning import BinnedResiduals, EpisodeEvidence
from .data.dataset import DiagnosisData, EpisodeCache

N_BIN_FIELDS = len(BinnedResiduals._fields)


def open_checkpoints(folder: Path, model: WorldModel, data: DiagnosisData, resume: bool | None) -> EpisodeCache:
    """Open a folder of finished episodes, which is made when the first one is finished.

    Args:
        folder: the folder.
        model: the base model.
        data: the episodes.
        resume: whether to continue; see ``diagnose``.

    Returns:
        A function of a question, a point and the work that answers it, which returns a stored answer if there is one.

    Raises:
        InvalidInput: nothing to resume, what another diagnosis left, or a folder with other content.
    """
    store = ResumableStore(folder, _describe_problem(model, data), resume)

    def answer(question: Sequence[object], point: Tensor, work: Callable[[], EpisodeEvidence]) -> EpisodeEvidence:
        def compute() -> tuple[Tensor, ...]:
            evidence = work()
            return (*evidence.bins, evidence.nuisance_stds, evidence.mesh_difference, evidence.is_simulated)

        columns = store.get_or_compute(f"episode{question[0]}-{digest(question)}", point, compute)
        return EpisodeEvidence(BinnedResiduals(*columns[:N_BIN_FIELDS]), *columns[N_BIN_FIELDS:])

    return answer


def _describe_problem(model: WorldModel, data: DiagnosisData) -> list[object]:
    """Return everything that an answer depends on besides the question."""
    cloth = cloth_fingerprint_parts(model.base.cloth)
    episodes = [part for e in data.episodes for part in (*e.fingerprint_parts(), *model.base.fingerprint_parts(e))]
    parameters = [(p.name, p.step, p.prior_std) for p in model.parameters]
    return [data.dt, data.clock_stds, parameters, *digest_user_files(), *cloth, data.rest_positions, *episodes]
