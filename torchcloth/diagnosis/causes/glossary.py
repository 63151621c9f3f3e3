"""Title and one sentence for each cause."""

from __future__ import annotations

from ...episodes.world import Hypothesis
from .catalogue import CATALOGUE

GLOSSARY = {h.effect: h.description for h in CATALOGUE}
CAUSE_TITLES = {h.effect: h.title for h in CATALOGUE}
EQUIVALENT_CAUSES = {  # by structure: no episode distinguishes them from a cause that is asked about
    "robot.base": "The robot stands elsewhere than stated: it looks as if the camera did.",
}


def describe(hypothesis: Hypothesis) -> str:
    """Return what a cause is, in one sentence; empty if nobody says so."""
    return hypothesis.description or GLOSSARY.get(hypothesis.effect, "")


def format_catalogue(hypotheses: list[Hypothesis]) -> str:
    """Return all causes as a table in Markdown; axes of one effect share a row."""
    rows = ["| cause | typical | meaning |", "|---|---|---|"]
    first = {h.effect: h for h in reversed(hypotheses)}
    for h in hypotheses:
        if first.get(h.effect) is h:
            unit = "" if h.unit == "-" else f" {h.unit}"
            rows.append(f"| `{h.effect}` | {h.typical:g}{unit} | {describe(h) or 'registered by a user'} |")
    return "\n".join(rows)
