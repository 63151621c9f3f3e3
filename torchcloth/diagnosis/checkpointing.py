"""Finished episodes on disk, so that a diagnosis that was stopped goes on where it was.

What an episode says at a point is a function of model, episode and question. A search is deterministic: run again, it
asks the same questions in the same order, and finds the answers of before, bit by bit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from torch import Tensor

from .._utils.resume import ResumableStore, digest
from ..episodes.cloth_facts import cloth_fingerprint_parts
from ..episodes.world import Model
from .causes.user_hypotheses import digests
from .data.binning import BinnedResiduals, EpisodeEvidence
from .data.dataset import EpisodeCache, DiagnosisData

FIELDS = len(BinnedResiduals._fields)


def kept_in(folder: Path, model: Model, setting: DiagnosisData, resume: bool | None) -> EpisodeCache:
    """Answers in a folder, which is made when the first is known.

    Raises:
        InvalidInput: nothing to resume, or what another diagnosis left; a folder of other things.
    """
    journal = ResumableStore(folder, _problem(model, setting), resume)

    def kept(question: Sequence[object], point: Tensor, work: Callable[[], EpisodeEvidence]) -> EpisodeEvidence:
        def flat() -> tuple[Tensor, ...]:
            found = work()
            return (*found.bins, found.nuisance_stds, found.mesh_difference, found.is_simulated)

        answer = journal.get_or_compute(f"episode{question[0]}-{digest(question)}", point, flat)
        return EpisodeEvidence(BinnedResiduals(*answer[:FIELDS]), *answer[FIELDS:])

    return kept


def _problem(model: Model, setting: DiagnosisData) -> list[object]:
    """All that an answer depends on beside the question."""
    cloth = model.base.cloth
    data = [part for e in setting.episodes for part in (*e.fingerprint_parts(), *model.base.identity(e))]
    parts = [(p.name, p.step, p.std) for p in model.parameters]
    return [setting.dt, parts, *digests(), *cloth_fingerprint_parts(cloth), setting.rest_positions, *data]
