"""A diagnosis as the command does it, for a study: its report stays in a folder, and a stopped one goes on."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from torchcloth._utils.files import PROGRESS_FOLDER_NAME
from torchcloth._utils.resume import clear_store
from torchcloth.diagnosis import Diagnosis, Hypothesis, WorldModel, diagnose, write_diagnosis
from torchcloth.recordings import Recording


def diagnosis_in(
    folder: Path,
    recordings: Sequence[Recording],
    model: WorldModel | None = None,
    hypotheses: Sequence[Hypothesis] | None = None,
) -> Diagnosis:
    """The answer, written to the folder; arguments and errors as in ``diagnose``."""
    journal = folder / PROGRESS_FOLDER_NAME
    answer = diagnose(recordings, model, hypotheses, journal=journal, resume=journal.exists())
    write_diagnosis(answer, recordings, folder)
    clear_store(journal)
    return answer
