"""Answers that are kept: found again, written whole, and never taken for those of another question or problem."""

import os

import pytest
import torch

from torchcloth.errors import InvalidInput
from torchcloth.identification.journal import Journal, digest

POINT = torch.tensor([1.0, 2.0], dtype=torch.float64)


def answer(number):
    return lambda: (torch.tensor([number]), None)


def test_an_answer_is_computed_once(tmp_path):
    kept = Journal(tmp_path / "j", ["a"], resume=False)
    assert float(kept.ask("rows", POINT, answer(1.0))[0]) == 1.0
    again = Journal(tmp_path / "j", ["a"], resume=True)
    found = again.ask("rows", POINT, lambda: pytest.fail("was known"))
    assert float(found[0]) == 1.0
    assert found[1] is None
    assert again.recalled == 1
    assert float(again.ask("other rows", POINT, answer(2.0))[0]) == 2.0
    assert float(again.ask("rows", POINT + 1e-16, lambda: pytest.fail("the same number"))[0]) == 1.0
    assert float(again.ask("rows", POINT + 1e-15, answer(3.0))[0]) == 3.0  # the next number is another question


@pytest.mark.parametrize("damage", ["cut", "junk", "empty"])
def test_a_damaged_answer_is_computed_anew(tmp_path, damage):
    Journal(tmp_path / "j", ["a"], resume=False).ask("rows", POINT, answer(1.0))
    (file,) = (tmp_path / "j").glob("*.pt")
    file.write_bytes({"cut": file.read_bytes()[:300], "junk": b"no tensor at all", "empty": b""}[damage])
    again = Journal(tmp_path / "j", ["a"], resume=True)
    assert float(again.ask("rows", POINT, answer(2.0))[0]) == 2.0
    assert again.recalled == 0


def test_another_problem_is_refused(tmp_path):
    Journal(tmp_path / "j", ["a", torch.zeros(3)], resume=False).ask("rows", POINT, answer(1.0))
    Journal(tmp_path / "j", ["a", torch.zeros(3)], resume=True)
    with pytest.raises(InvalidInput, match="of another fit; expected the same episodes"):
        Journal(tmp_path / "j", ["a", torch.ones(3)], resume=True)
    with pytest.raises(InvalidInput, match=r"resume; got no .*; expected what an interrupted run left"):
        Journal(tmp_path / "nowhere", ["a"], resume=True)


def test_without_resuming_nothing_is_found(tmp_path):
    Journal(tmp_path / "j", ["a"], resume=False).ask("rows", POINT, answer(1.0))
    assert float(Journal(tmp_path / "j", ["a"], resume=False).ask("rows", POINT, answer(2.0))[0]) == 2.0


def test_other_files_are_not_removed(tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(InvalidInput, match="with other content"):
        Journal(tmp_path, ["a"], resume=False)
    assert (tmp_path / "thesis.tex").exists()


def test_an_interrupt_while_writing_leaves_no_answer(tmp_path, monkeypatch):
    kept = Journal(tmp_path / "j", ["a"], resume=False)
    monkeypatch.setattr(os, "replace", lambda a, b: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        kept.ask("rows", POINT, answer(1.0))
    monkeypatch.undo()
    assert float(Journal(tmp_path / "j", ["a"], resume=True).ask("rows", POINT, answer(2.0))[0]) == 2.0


def test_fingerprints_tell_apart_what_is_joined():
    assert digest(["ab", "c"]) != digest(["a", "bc"])
    assert digest([torch.zeros(2)]) == digest([torch.zeros(4)[:2]])
