"""The verdict of a fit in one line: what it identified, what it did not, and why."""

from __future__ import annotations

from .result import Identification
from .uncertainty.likely_reasons import MIN_REASON_SHARE, REASON_WORDS


def describe_verdict(fit: Identification) -> str:
    """Return one line in plain words: what is identified, what is not, and the most likely reason of a misfit.

    Parameters that were measured beforehand or held fixed are left out.
    """
    fitted = {name: e.identifiable for name, e in fit.parameters.items() if e.source == "data"}
    identified = [name for name, is_identifiable in fitted.items() if is_identifiable]
    others = [name for name in fitted if name not in identified]
    parts = [f"Identified: {', '.join(identified) or 'nothing'}."]
    if others:
        parts.append(f"Not identifiable: {', '.join(others)}.")
    return " ".join([*parts, *_describe_reason(fit, others)])


def _describe_reason(fit: Identification, others: list[str]) -> list[str]:
    """Sentence on why nothing is identified, or on what would determine the others; none where all is known."""
    if fit.likely_reasons:
        name, share = max(fit.likely_reasons.items(), key=lambda item: item[1])
        if share >= MIN_REASON_SHARE:
            return [f"Most likely reason of the misfit: {REASON_WORDS[name]}."]
        return ["No error of the recording explains the misfit: `torchcloth diagnose` looks for what the model lacks."]
    if fit.is_withdrawn:
        return ["The notes above the tables say why."]
    if any(fit.influences[name].experiment for name in others if name in fit.influences):
        return ["The column 'to determine it' says which motion would show it."]
    return []
