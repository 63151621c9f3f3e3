"""Finished episodes on disk, so that a diagnosis that was stopped goes on where it was.

What an episode says at a point is a function of model, episode and question. A search is deterministic: run again, it
asks the same questions in the same order, and finds the answers of before, bit by bit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from torch import Tensor

from .._utils.resume import Journal, digest
from ..episodes.cloth_facts import facts_of
from ..episodes.world import Model
from .causes.user_hypotheses import digests
from .data.binning import Cells, Piece
from .data.dataset import Kept, Setting

FIELDS = len(Cells._fields)


def kept_in(folder: Path, model: Model, setting: Setting, resume: bool | None) -> Kept:
    """Answers in a folder, which is made when the first is known.

    Raises:
        InvalidInput: nothing to resume, or what another diagnosis left; a folder of other things.
    """
    journal = Journal(folder, _problem(model, setting), resume)

    def kept(question: Sequence[object], point: Tensor, work: Callable[[], Piece]) -> Piece:
        def flat() -> tuple[Tensor, ...]:
            found = work()
            return (*found.cells, found.std, found.numerics, found.able)

        answer = journal.ask(f"episode{question[0]}-{digest(question)}", point, flat)
        return Piece(Cells(*answer[:FIELDS]), *answer[FIELDS:])

    return kept


def _problem(model: Model, setting: Setting) -> list[object]:
    """All that an answer depends on beside the question."""
    cloth = model.base.cloth
    data = [part for e in setting.episodes for part in (*e.identity(), *model.base.identity(e))]
    parts = [(p.name, p.step, p.std) for p in model.parameters]
    return [setting.dt, parts, *digests(), *facts_of(cloth), setting.rest, *data]
