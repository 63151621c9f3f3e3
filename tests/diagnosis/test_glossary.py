"""Every cause has its sentence, here and in the docs."""

from pathlib import Path

import pytest

from torchcloth.diagnosis import Hypothesis, register
from torchcloth.diagnosis.causes.glossary import GLOSSARY, format_catalogue
from torchcloth.diagnosis.causes.hypotheses import list_known_hypotheses
from torchcloth.errors import InvalidInput

DOCS = Path(__file__).parents[2] / "docs" / "reference" / "causes.md"


def test_every_cause_has_a_sentence_and_no_other_has():
    assert set(GLOSSARY) == {h.effect for h in list_known_hypotheses()}
    assert all(text.endswith(".") and text.count(". ") == 0 for text in GLOSSARY.values())


def test_the_docs_have_the_table():
    assert "<!-- table: causes -->" in DOCS.read_text(encoding="utf-8")
    rows = format_catalogue(list_known_hypotheses()).splitlines()
    assert len(rows) == 2 + len(GLOSSARY)
    assert rows[2].startswith("| `air.drag_n` | 1.2 | Air pushes against cloth")


def test_a_name_of_the_catalogue_is_not_for_users():
    with pytest.raises(InvalidInput, match=r"'air\.drag_n', which the catalogue has.*'my\.drag_n'"):
        register(Hypothesis("air.drag_n", "-", 1.0, lambda world, _: world))
    for typical in (0.0, -0.1):
        with pytest.raises(
            InvalidInput, match=rf"typical of 'my\.less'; got {typical}; expected a value > 0, or signed"
        ):
            register(Hypothesis("my.less", "-", typical, lambda world, _: world))
