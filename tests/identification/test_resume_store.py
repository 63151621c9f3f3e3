"""Stored results are found again, are written whole, and are never used for another problem."""

import os
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers import twins

import torchcloth as tc
from torchcloth._utils import resume
from torchcloth._utils.resume import ResumableStore, digest
from torchcloth.episodes.cloth_fingerprint import cloth_fingerprint_parts
from torchcloth.episodes.observed import build_episode
from torchcloth.episodes.unknowns import collect_unknowns
from torchcloth.errors import InvalidInput
from torchcloth.identification import identify
from torchcloth.identification.estimators.objective import Objective
from torchcloth.identification.residuals.blocks import select_blocks

POINT = torch.tensor([1.0, 2.0], dtype=torch.float64)


def answer(number):
    return lambda: (torch.tensor([number]), None)


def test_an_answer_is_computed_once(tmp_path):
    stored = ResumableStore(tmp_path / "j", ["a"], resume=False)
    assert float(stored.get_or_compute("rows", POINT, answer(1.0))[0]) == 1.0
    again = ResumableStore(tmp_path / "j", ["a"], resume=True)
    result = again.get_or_compute("rows", POINT, lambda: pytest.fail("was known"))
    assert float(result[0]) == 1.0
    assert result[1] is None
    assert again.reused_count == 1
    assert float(again.get_or_compute("other rows", POINT, answer(2.0))[0]) == 2.0
    assert float(again.get_or_compute("rows", POINT + 1e-16, lambda: pytest.fail("the same number"))[0]) == 1.0
    assert (
        float(again.get_or_compute("rows", POINT + 1e-15, answer(3.0))[0]) == 3.0
    )  # the next number is another question


@pytest.mark.parametrize("damage", ["cut", "junk", "empty"])
def test_a_damaged_answer_is_computed_anew(tmp_path, damage):
    ResumableStore(tmp_path / "j", ["a"], resume=False).get_or_compute("rows", POINT, answer(1.0))
    (file,) = (tmp_path / "j").glob("*.pt")
    file.write_bytes({"cut": file.read_bytes()[:300], "junk": b"no tensor at all", "empty": b""}[damage])
    again = ResumableStore(tmp_path / "j", ["a"], resume=True)
    assert float(again.get_or_compute("rows", POINT, answer(2.0))[0]) == 2.0
    assert again.reused_count == 0


class Touch:
    """Makes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_an_answer_runs_no_code(tmp_path):
    ResumableStore(tmp_path / "j", ["a"], resume=False).get_or_compute("rows", POINT, answer(1.0))
    (file,) = (tmp_path / "j").glob("*.pt")
    torch.save((Touch(tmp_path / "called"),), file)
    again = ResumableStore(tmp_path / "j", ["a"], resume=True)
    assert float(again.get_or_compute("rows", POINT, answer(2.0))[0]) == 2.0
    assert not (tmp_path / "called").exists()


def test_another_problem_is_refused(tmp_path):
    ResumableStore(tmp_path / "j", ["a", torch.zeros(3)], resume=False).get_or_compute("rows", POINT, answer(1.0))
    ResumableStore(tmp_path / "j", ["a", torch.zeros(3)], resume=True)
    with pytest.raises(InvalidInput, match=r"of another fit, or of another version .*; expected the same episodes"):
        ResumableStore(tmp_path / "j", ["a", torch.ones(3)], resume=True)
    with pytest.raises(InvalidInput, match=r"resume; got no .*; expected what an interrupted run left"):
        ResumableStore(tmp_path / "nowhere", ["a"], resume=True)


def test_stopped_work_is_not_deleted_by_other_work(tmp_path):
    """A command into the same folder: hours may lie there."""
    stored = ResumableStore(tmp_path / "j", ["a"], resume=None)
    stored.get_or_compute("rows", POINT, answer(1.0))
    for problem, said in ((["a"], "the same work"), (["b"], "other work")):
        with pytest.raises(InvalidInput, match=f"{said}, stopped; .*delete"):
            ResumableStore(tmp_path / "j", problem, resume=None)
    assert (
        float(ResumableStore(tmp_path / "j", ["a"], resume=True).get_or_compute("rows", POINT, answer(2.0))[0]) == 1.0
    )


def test_another_program_answers_anew(tmp_path, monkeypatch):
    ResumableStore(tmp_path / "j", ["a"], resume=None).get_or_compute("rows", POINT, answer(1.0))
    monkeypatch.setattr(resume, "source_fingerprint", lambda: "another")
    with pytest.raises(InvalidInput, match="another version of torchcloth"):
        ResumableStore(tmp_path / "j", ["a"], resume=True)


def test_without_resuming_nothing_is_found(tmp_path):
    ResumableStore(tmp_path / "j", ["a"], resume=False).get_or_compute("rows", POINT, answer(1.0))
    assert (
        float(ResumableStore(tmp_path / "j", ["a"], resume=False).get_or_compute("rows", POINT, answer(2.0))[0]) == 2.0
    )


def test_other_files_are_not_removed(tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(InvalidInput, match="with other content"):
        ResumableStore(tmp_path, ["a"], resume=False)
    assert (tmp_path / "thesis.tex").exists()


@pytest.mark.parametrize("half", ["folder", "stamp"])
def test_a_folder_that_was_begun_when_all_ended_is_begun_again(tmp_path, half):
    (tmp_path / "j").mkdir()
    if half == "stamp":
        (tmp_path / "j" / ".problem.0a1b").write_text("0")
    assert (
        float(ResumableStore(tmp_path / "j", ["a"], resume=None).get_or_compute("rows", POINT, answer(1.0))[0]) == 1.0
    )
    assert (
        float(ResumableStore(tmp_path / "j", ["a"], resume=True).get_or_compute("rows", POINT, answer(2.0))[0]) == 1.0
    )
    assert sorted(path.suffix for path in (tmp_path / "j").iterdir()) in (["", ".pt"], ["", "", ".pt"])


def test_a_folder_whose_removal_was_interrupted_is_a_journal_still(tmp_path, monkeypatch):
    stored = ResumableStore(tmp_path / "j", ["a"], resume=False)
    for number in range(3):
        stored.get_or_compute("rows", POINT + number, answer(1.0))
    unlink, removed = Path.unlink, []

    def interrupted(path, **options):
        removed.append(path)
        if len(removed) > 2:
            raise KeyboardInterrupt
        unlink(path, **options)

    monkeypatch.setattr(Path, "unlink", interrupted)
    with pytest.raises(KeyboardInterrupt):
        resume.clear_store(tmp_path / "j")
    monkeypatch.undo()
    ResumableStore(tmp_path / "j", ["a"], resume=True)
    resume.clear_store(tmp_path / "j")
    assert not (tmp_path / "j").exists()


def test_an_interrupt_while_writing_leaves_no_answer(tmp_path, monkeypatch):
    stored = ResumableStore(tmp_path / "j", ["a"], resume=False)
    stored.get_or_compute("other rows", POINT, answer(0.0))
    monkeypatch.setattr(os, "replace", lambda a, b: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        stored.get_or_compute("rows", POINT, answer(1.0))
    monkeypatch.undo()
    assert (
        float(ResumableStore(tmp_path / "j", ["a"], resume=True).get_or_compute("rows", POINT, answer(2.0))[0]) == 2.0
    )


def test_fingerprints_tell_apart_what_is_joined():
    assert digest(["ab", "c"]) != digest(["a", "bc"])
    assert digest([torch.zeros(2)]) == digest([torch.zeros(4)[:2]])


@pytest.mark.parametrize(
    "other",
    [
        lambda r: replace(r, air_density=0.3),
        lambda r: replace(r, grasps={n: replace(g, radius=1.5 * g.radius) for n, g in r.grasps.items()}),
        lambda r: replace(r, grippers={n: replace(g, t=1.5 * g.t) for n, g in r.grippers.items()}),
    ],
    ids=["air", "radius", "times"],
)
def test_what_is_no_tensor_tells_problems_apart(recording, other):
    ids = []
    for made in (recording, other(recording)):
        cloth = twins.build_cloth_at(made)
        objective = Objective(cloth, collect_unknowns(cloth, ["youngs_modulus"], None), [build_episode(cloth, made)])
        ids.append(digest(objective.fingerprint_parts()))
    assert ids[0] != ids[1]


def test_another_law_with_the_same_numbers_is_another_problem():
    class Heavier(tc.effects.Gravity):
        def force(self, c, inputs):
            return 2 * super().force(c, inputs)

    mesh = tc.meshes.rectangle(0.1, 0.1, triangles=8)
    facts = [
        digest(cloth_fingerprint_parts(tc.Cloth(mesh, tc.materials.AEP(1e5), 0.2, {"gravity": weight()}, contact=None)))
        for weight in (tc.effects.Gravity, Heavier)
    ]
    assert facts[0] != facts[1]


def test_another_engine_is_another_problem(recording):
    """Its last digits differ, and a fit goes on bit by bit."""
    cloth, ids = twins.build_cloth_at(recording), []
    for cloth.engine in ("fused", "reference"):
        objective = Objective(
            cloth, collect_unknowns(cloth, ["youngs_modulus"], None), [build_episode(cloth, recording)]
        )
        ids.append(digest(objective.fingerprint_parts()))
    assert ids[0] != ids[1]


def test_beginnings_of_several_episodes_are_told_apart(recording, tmp_path):
    """The first is so short that its beginning is all of it."""
    both = [twins.take_first_frames(twins.make_twin(seed=3), 4), recording]
    names = ["youngs_modulus", "air.normal"]
    plain = identify(twins.build_cloth_at(both[0]), both, names, iterations=1, exact_bench=True)
    stored = identify(
        twins.build_cloth_at(both[0]), both, names, iterations=1, journal=tmp_path / "journal", exact_bench=True
    )
    assert stored.parameters["youngs_modulus"].value == plain.parameters["youngs_modulus"].value


def test_distances_of_one_kind_of_data_are_stored(recording, tmp_path):
    """`identify --use points` once ended in a TypeError here."""
    cloth = twins.build_cloth_at(recording)
    distances = []
    for resumed in (None, False, True):
        objective = Objective(
            cloth,
            collect_unknowns(cloth, ["youngs_modulus"], None),
            [build_episode(cloth, recording)],
            blocks=select_blocks("points"),
        )
        if resumed is not None:
            objective.journal = ResumableStore(tmp_path / "j", ["a"], resume=resumed)
        distances.append(objective.mean_distance(objective.start))
    assert 0 < distances[0] == distances[1] == distances[2]
    assert objective.journal.reused_count == 1


def test_all_code_that_answers_is_in_the_fingerprint(tmp_path, monkeypatch):
    """An editable install keeps the robots beside the library, not in it."""
    monkeypatch.setattr(resume, "files", lambda name: tmp_path / name)
    places = [tmp_path / "torchcloth" / "a.py", tmp_path / "torchcloth.robots" / "arm.py", tmp_path / "studies" / "s.h"]
    for place in places:
        place.parent.mkdir()
        place.write_text("1")
    known = [resume.source_fingerprint.__wrapped__(tmp_path / "studies")]
    for place in places:
        place.write_text("2")
        known.append(resume.source_fingerprint.__wrapped__(tmp_path / "studies"))
    assert len(set(known)) == 4


def test_two_problems_at_work_in_one_folder_do_not_share_answers(tmp_path):
    """Neither had begun when the other looked; one that ends takes the folder away, and the other goes on."""
    one, other = ResumableStore(tmp_path / "j", ["a"], resume=None), ResumableStore(tmp_path / "j", ["b"], resume=None)
    assert float(one.get_or_compute("rows", POINT, answer(1.0))[0]) == 1.0
    assert float(other.get_or_compute("rows", POINT, answer(2.0))[0]) == 2.0
    resume.clear_store(tmp_path / "j")
    resume.clear_store(tmp_path / "j")
    assert float(other.get_or_compute("rows", POINT, answer(3.0))[0]) == 3.0
    assert (tmp_path / "j" / resume.STAMP_FILE_NAME).read_text() == other.key
