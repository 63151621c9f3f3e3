"""Resumable diagnosis for a study, as the command ``torchcloth diagnose`` runs it."""

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
    """Run a diagnosis or resume a stopped one, and write it to the folder; see ``diagnose`` for the arguments."""
    journal = folder / PROGRESS_FOLDER_NAME
    answer = diagnose(recordings, model, hypotheses, journal=journal, resume=journal.exists(), checks=False)
    write_diagnosis(answer, recordings, folder)
    clear_store(journal)
    return answer
