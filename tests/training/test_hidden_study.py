"""The hidden round as a study: what each process is given, in which order, and what is kept."""

import csv
import json
import lzma
from argparse import Namespace
from pathlib import Path

import numpy as np
import pytest

from torchcloth.diagnosis.experiment.motions import Experiment
from torchcloth.errors import InvalidInput
from torchcloth.training import resumable
from torchcloth.training.studies import hidden, hidden_archive, hidden_tables
from torchcloth.training.studies.command import main
from torchcloth.training.validation.hidden import case_sampling, reveal_truth

VALIDATION = "torchcloth.training.validation.hidden."
ANSWER = {"verdict": "adequate", "causes": [], "unresolvable": [], "undecided": [], "model": None}


@pytest.fixture
def called(monkeypatch):
    """Commands instead of processes: making leaves two folders, and what it was stopped in before."""
    commands = []

    def run(command):
        arguments = command[2:] if command[2].startswith(VALIDATION) else command[1:]
        commands.append([Path(a).name if "/" in a else a.removeprefix(VALIDATION) for a in arguments])
        out = Path(command[command.index("--out") + 1]) if "--out" in command else None
        if "diagnose" in command:
            (out / "diagnosis.json").parent.mkdir(parents=True)
            (out / "diagnosis.json").write_text(json.dumps(ANSWER))
        elif out is not None:
            for name in ("e1", "e2", ".e2.0123.partial"):
                (out / name).mkdir(parents=True)
            return Namespace(returncode=0, stdout=f"{out / 'e1'}: hang\n{out / 'e2'}: turn\n", stderr="")
        elif "visibility" in commands[-1]:
            sizes = [{"name": "x.jet", "unexplained_displacement_rms_m": 1e-3, "unexplained_force_rms_n": 0.0}]
            return Namespace(returncode=0, stdout=json.dumps(sizes), stderr="")
        else:  # what reveal_truth prints
            seed = int(command[command.index("--seed") + 1])
            truth = reveal_truth.reveal_truth(case_sampling.draw_case(seed))
            return Namespace(returncode=0, stdout=json.dumps(truth), stderr="")
        return Namespace(returncode=0, stdout="", stderr="")

    monkeypatch.setattr(hidden, "_run", run)
    return commands


def options(tmp_path, **more):
    return Namespace(
        **{"out": tmp_path / "s", "cases": None, "seed": None, "dev": False, "fast": False, "jobs": 1, "answers": None}
        | more
    )


def test_the_truth_is_opened_after_the_answer_and_nothing_is_told(called, tmp_path):
    hidden.run(options(tmp_path, dev=True, cases=2))
    kinds = [command[0] if command[0] != "-m" else command[2] for command in called]
    assert kinds == ["make_case", "diagnose", "reveal_truth"] * 2
    assert called[1] == ["-m", "torchcloth.cli", "diagnose", "e1", "e2", "--out", "001", "--no-checks"]
    resumable = json.loads((tmp_path / "s" / "cases" / "001.json").read_text())
    assert resumable["truth"]["family"] == "null"
    assert resumable["answer"] == ANSWER


def test_what_the_catalogue_does_not_know_is_asked_whether_it_shows(called, tmp_path):
    seed = next(s for s in range(20) if case_sampling.draw_case(s).family == "outside")
    assert hidden.run_case(tmp_path, "001", seed, False)["sizes"][0]["name"] == "x.jet"
    assert [c[0] for c in called].index("visibility") > [c[0] for c in called].index("reveal_truth")


def test_finished_cases_are_not_repeated_and_more_may_be_added(called, tmp_path, capsys):
    hidden.run(options(tmp_path, seed=9, cases=3))
    first = (tmp_path / "s" / "cases" / "002.json").read_text()
    del called[:]
    hidden.run(options(tmp_path, cases=4))  # the folder remembers its secret
    assert len([c for c in called if "make_case" in c]) == 1
    assert (tmp_path / "s" / "cases" / "002.json").read_text() == first
    assert "What must show" in capsys.readouterr().out
    assert (tmp_path / "s" / "hidden.md").read_text().count("| 00") == 4


def test_rounds_are_scored_side_by_side_and_together(called, tmp_path, capsys):
    for name, count in (("one", 3), ("two", 5)):
        hidden.run(options(tmp_path, out=tmp_path / name, dev=True, cases=count))
    del called[:]
    hidden_archive.write_archive(tmp_path / "two", tmp_path / "x.jsonl.xz", "two", "2026-01-01T00:00:00+00:00")
    for two in ("two", "x.jsonl.xz"):
        hidden.run(options(tmp_path, out=tmp_path / "both", answers=[tmp_path / "one", tmp_path / two]))
        assert not called
        assert "rounds.md" in capsys.readouterr().out
        lines = (tmp_path / "both" / "rounds.md").read_text().splitlines()
        columns = "one (3) | two (5)" if two == "two" else "two (5) | one (3)"  # what has a date comes first
        assert lines[0] == f"| figure | {columns} | together | 95 % |"
        assert sum("0 of 3" in line and "0 of 5" in line and "0 of 8" in line for line in lines) > 0
        assert "| one effect, class identified | half its typical size | typical | 1.5 | of all that show |" in lines
        assert (tmp_path / "both" / "hidden.md").read_text().count("| two/00") == 5
        rows = (tmp_path / "both" / "rounds.csv").read_text().splitlines()
        assert sum(row.startswith("two,5,") for row in rows) == sum(row.startswith("one,3,") for row in rows) > 30
    with pytest.raises(InvalidInput, match="--out"):
        hidden.run(options(tmp_path, out=tmp_path / "one", answers=[tmp_path / "two"]))


def test_archived_rounds_are_scored_as_the_page_has_them(tmp_path):
    """If a label or a key is renamed: a row of ``RENAMED_KEYS`` for keys, and rounds.csv written again for labels."""
    folder = Path(__file__).parents[2] / "docs" / "validation" / "blind-rounds"
    archives = sorted((folder / "answers").glob("*.jsonl.xz"))
    assert all(path.stat().st_size < 200_000 for path in archives)
    rounds = hidden.score_rounds(options(tmp_path, answers=archives))
    fresh = list(csv.reader(hidden_tables.rounds_csv(rounds).splitlines()))
    stored = list(csv.reader((folder / "rounds.csv").read_text().splitlines()))
    assert sum(len(cases) for cases in rounds.values()) == 532
    assert [row for row in stored if row[0] in ("round", *rounds)] == fresh


def test_keys_of_old_files_get_their_present_names(monkeypatch):
    table = {"truth.effects.old": "new", "answer.one": "two", "answer.one.left": "right"}
    monkeypatch.setattr(hidden_archive, "RENAMED_KEYS", {7: table})
    monkeypatch.setattr(hidden_archive, "CURRENT_SCHEMA", 8)
    before = {"one": [{"left": [{"left": 1}]}], "gain": {"one": 2}}
    after = {"two": [{"right": [{"left": 1}]}], "gain": {"one": 2}}
    case = {"truth": {"effects": [{"old": True}]}, "answer": before, "next": {"proposed": before, "random": None}}
    expected = {"truth": {"effects": [{"new": True}]}, "answer": after, "next": {"proposed": after, "random": None}}
    assert hidden_archive.upgrade(case, 7) == expected
    assert hidden_archive.upgrade(expected, 8) == expected
    with pytest.raises(ValueError, match="schema 6"):
        hidden_archive.upgrade(case, 6)


@pytest.mark.parametrize(
    "content", [None, "{", "{}", "[]", "null", '{"truth": {}, "answer": []}', '{"truth": 1, "answer": 2}']
)
def test_a_folder_without_a_round_is_refused(tmp_path, content):
    (tmp_path / "r" / "cases").mkdir(parents=True)
    if content is not None:
        (tmp_path / "r" / "cases" / "001.json").write_text(content)
    with pytest.raises(InvalidInput, match="--answers"):
        hidden.run(options(tmp_path, answers=[tmp_path / "r"]))
    assert not (tmp_path / "s").exists()


@pytest.mark.parametrize(
    "lines", ["", "{", "[]", '{"schema": 1, "round": "r", "date": ""}', '{"schema": 99}\n{"name": "1"}', "{}\n{}"]
)
def test_a_file_that_is_no_archive_is_refused(tmp_path, lines):
    (tmp_path / "plain").write_text(lines)
    with lzma.open(tmp_path / "packed", "wt") as file:
        file.write(lines)
    for name in ("plain", "packed", "missing"):
        with pytest.raises(InvalidInput, match="--answers"):
            hidden.run(options(tmp_path, answers=[tmp_path / name]))


@pytest.mark.parametrize(
    "wrong",
    [{"answers": ["a/r", "b/r"]}, {"cases": 3}, {"fast": True}, {"jobs": 0}],
    ids=lambda wrong: next(iter(wrong)),
)
def test_rounds_have_different_names_and_draw_nothing(called, tmp_path, wrong):
    for name in ("a/r", "b/r"):
        hidden.run(options(tmp_path, out=tmp_path / name, dev=True, cases=1))
    rounds = [tmp_path / name for name in wrong.get("answers", ["a/r"])]
    with pytest.raises(InvalidInput, match="--answers"):
        hidden.run(options(tmp_path, **wrong | {"answers": rounds}))


def test_a_round_that_is_stopped_in_its_first_case_keeps_its_secret(called, tmp_path, monkeypatch):
    def stopped(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(hidden, "diagnose_episodes", stopped)
        with pytest.raises(KeyboardInterrupt):
            hidden.run(options(tmp_path, cases=1))
    secret = json.loads((tmp_path / "s" / "study.json").read_text())["secret"]
    assert hidden.draw_round(options(tmp_path)).settings["secret"] == secret


def test_what_another_version_has_begun_is_begun_anew(called, tmp_path, monkeypatch):
    (tmp_path / "a" / "progress").mkdir(parents=True)
    usual = hidden._run

    def run(command):
        if "--resume" in command:
            return Namespace(returncode=2, stdout="", stderr="resume; got progress of another fit")
        (tmp_path / "a").rmdir()  # empty by now
        return usual(command)

    monkeypatch.setattr(hidden, "_run", run)
    assert hidden.diagnose_episodes([tmp_path / "e1"], tmp_path / "a") == ANSWER


def test_secrets_are_kept_fresh_ones_differ_and_development_is_no_secret(tmp_path):
    one, two = (hidden.draw_round(options(tmp_path / name)) for name in "ab")
    assert one.settings["secret"] != two.settings["secret"]
    assert len(one.seeds) == hidden.DEFAULT_CASES
    assert min(one.seeds.values()) >= 100_000
    dev = hidden.draw_round(options(tmp_path, dev=True, cases=5))
    assert list(dev.seeds.values()) == [0, 1, 2, 3, 4]
    assert dev.settings["secret"] is None
    for wrong in ({"cases": 0}, {"dev": True, "cases": 1001}):
        with pytest.raises(InvalidInput, match="--cases"):
            hidden.draw_round(options(tmp_path, **wrong))


def test_an_answer_that_is_none_says_how_it_ended(monkeypatch, tmp_path):
    for code, word in ((2, "refused"), (-11, "failed")):
        ended = Namespace(returncode=code, stdout="", stderr="progress\npoints.npz: t does not increase")
        monkeypatch.setattr(hidden, "_run", lambda command, ended=ended: ended)
        answer = hidden.diagnose_episodes([tmp_path / "e1"], tmp_path / word)
        assert answer == {
            word: "points.npz: t does not increase",
            "stderr": ["progress", "points.npz: t does not increase"],
        }
        assert json.loads((tmp_path / word / "diagnosis.json").read_text()) == answer


def test_an_answer_stays_once_its_truth_may_be_open(monkeypatch, tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "diagnosis.json").write_text(json.dumps(ANSWER))
    monkeypatch.delattr(hidden, "_run")
    assert hidden.diagnose_episodes([tmp_path / "e1"], tmp_path / "a") == ANSWER


def test_what_the_system_kills_is_no_answer(monkeypatch, tmp_path):
    """For want of memory; a crash of its own is one that failed."""
    monkeypatch.setattr(hidden, "_run", lambda _: Namespace(returncode=-9, stdout="", stderr=""))
    with pytest.raises(KeyboardInterrupt):
        hidden.diagnose_episodes([tmp_path / "e1"], tmp_path / "a")
    assert not (tmp_path / "a").exists()


def test_one_round_is_of_one_code(called, tmp_path, monkeypatch):
    hidden.run(options(tmp_path, seed=9, cases=1))
    monkeypatch.setattr(resumable, "source_fingerprint", lambda *folders: "another")
    with pytest.raises(InvalidInput, match="holds a study with code"):
        hidden.run(options(tmp_path, cases=2))


def test_a_diagnosis_that_was_stopped_is_no_answer_and_goes_on(monkeypatch, tmp_path):
    commands = []

    def run(command):
        commands.append(command)
        (tmp_path / "a" / "progress").mkdir(parents=True, exist_ok=True)
        if len(commands) == 1:
            return Namespace(returncode=130, stdout="", stderr="torchcloth: stopped; `--resume` goes on from there")
        (tmp_path / "a" / "diagnosis.json").write_text(json.dumps(ANSWER))
        return Namespace(returncode=0, stdout="", stderr="")

    monkeypatch.setattr(hidden, "_run", run)
    with pytest.raises(KeyboardInterrupt):
        hidden.diagnose_episodes([tmp_path / "e1"], tmp_path / "a")
    assert hidden.diagnose_episodes([tmp_path / "e1"], tmp_path / "a") == ANSWER
    assert ["--resume" in command for command in commands] == [False, True]


def test_experiments_are_made_of_the_same_case_and_answered_with_all_episodes(called, tmp_path, monkeypatch):
    monkeypatch.setattr(hidden, "read", lambda path: path)
    monkeypatch.setattr(
        hidden, "list_experiments", lambda episodes: [(Experiment("hang"), None), (Experiment("turn"), episodes)]
    )
    monkeypatch.setattr(hidden, "measure_heading", lambda template: np.deg2rad(5.0 * len(template)))
    made = []

    def make(*arguments):
        made.append(arguments)
        return f"{arguments[-1]}/e9: {arguments[1]}\n"

    asked = ANSWER | {"next_experiment": {"motion": "turn", "heading": 90.0, "separates": ["a", "b"]}}
    answer = hidden.answer_after_experiments(tmp_path, "007", make, [tmp_path / "e1"], asked, 19)
    assert made[0] == ("--motion", "turn", "--heading", "95.0", "--out", str(tmp_path / "episodes" / "007-proposed"))
    assert made[1][0] == "--motion"
    assert called[0][2:] == ["diagnose", "e1", "e9", "--out", "007-proposed", "--no-checks"]
    assert answer == {"proposed": ANSWER, "random": ANSWER}
    assert hidden.answer_after_experiments(tmp_path, "008", make, [], ANSWER, 19) == {"proposed": None, "random": None}


def test_a_case_that_needs_no_experiment_tells_nothing_of_experiments():
    seed = next(s for s in range(20) if case_sampling.draw_case(s).family == "next experiment")
    truth = reveal_truth.reveal_truth(case_sampling.draw_case(seed))
    (name,) = (e["hypothesis"] for e in truth["effects"] if not e["is_enabling"])
    cause = {"effect": name, "amplitude": 1.0, "equivalence_class": [name], "rivals": [], "ci95": [0.0, 2.0]}
    sure, unsure = ANSWER | {"causes": [cause]}, ANSWER | {"causes": [cause | {"rivals": [{"effect": "my.own"}]}]}
    none = {"proposed": None, "random": None}

    def resolved(answer, later):
        return hidden.score_answer("1", {"truth": truth, "answer": answer, "next": later})["resolved"]

    assert resolved(sure, none) is None
    partly = ANSWER | {"causes": [*sure["causes"], *unsure["causes"]]}
    assert resolved(partly, {"proposed": sure, "random": sure}) is None
    assert resolved(unsure, none) is False
    assert resolved(unsure, {"proposed": sure, "random": unsure}) is True
    assert resolved(unsure, {"proposed": unsure, "random": unsure}) is False


def test_wrong_options_are_one_line(tmp_path, capsys):
    assert main(["hidden", "--out", str(tmp_path / "s"), "--cases", "0"]) == 2
    assert capsys.readouterr().err.startswith("studies: --cases")
    assert not (tmp_path / "s").exists()


def test_the_small_round_is_always_the_same(tmp_path):
    small = hidden.draw_round(options(tmp_path, fast=True))
    assert tuple(small.seeds.values()) == hidden.FAST_SEEDS
    assert min(hidden.FAST_SEEDS) >= 100_000
    assert len(hidden.draw_round(options(tmp_path, fast=True, seed=4, cases=9)).seeds) == 9
    count = len(hidden.FAST_SEEDS)
    with pytest.raises(InvalidInput, match=f"--cases; got {count + 1}; expected at most {count}"):
        hidden.draw_round(options(tmp_path, fast=True, cases=count + 1))
