"""Studies on disk: what is finished is never done twice, and other settings are refused."""

import math
import threading

import pytest

from torchcloth.errors import InvalidInput, RecordingError
from torchcloth.training.resumable import ResumableStudy


def test_a_stopped_study_goes_on_where_it_was(tmp_path, capsys):
    called = []

    def case(name):
        def work():
            called.append(name)
            if name == "c" and called.count("c") == 1:
                raise KeyboardInterrupt
            return {"name": name, "value": 0.1 + 0.2}

        return work

    cases = {name: case(name) for name in "abcd"}
    with pytest.raises(KeyboardInterrupt):
        ResumableStudy(tmp_path / "s", {"points": 3}).run(cases)
    results = ResumableStudy(tmp_path / "s", {"points": 3}).run(cases)
    assert called == ["a", "b", "c", "c", "d"]
    assert results == {name: {"name": name, "value": 0.1 + 0.2} for name in "abcd"}  # exact: JSON keeps doubles
    assert "4/4 d" in capsys.readouterr().out


def test_cases_run_at_a_time(tmp_path, capsys):
    both = threading.Barrier(2, timeout=20)

    def case(name):
        def work():
            both.wait()  # never, one after the other
            return {"name": name}

        return work

    cases = {name: case(name) for name in "abcd"}
    assert ResumableStudy(tmp_path / "s", {}).run(cases, jobs=2) == {name: {"name": name} for name in "abcd"}
    assert "4/4" in capsys.readouterr().out


def test_an_error_ends_a_study_of_several_jobs(tmp_path):
    def work():
        raise InvalidInput("x", got=1, expected=2)

    never = {str(k): lambda: {} for k in range(50)}
    with pytest.raises(InvalidInput):
        ResumableStudy(tmp_path / "s", {}).run({"bad": work} | never, jobs=2)


def test_settings_are_known_from_where_a_study_begins(tmp_path):
    """Cases that leave more than a result would else be taken for those of other settings."""
    ResumableStudy(tmp_path / "s", {"secret": 3}).start()
    with pytest.raises(InvalidInput, match="which holds a study with secret 3; expected secret 4"):
        ResumableStudy(tmp_path / "s", {"secret": 4})


def test_nothing_is_written_before_a_case_is_finished(tmp_path):
    assert ResumableStudy(tmp_path / "s", {}).load_case("a") is None
    with pytest.raises(TypeError, match="not JSON serializable"):
        ResumableStudy(tmp_path / "s", {}).save_case("a", {"value": object()})
    assert ResumableStudy(tmp_path / "s", {}).load_case("a") is None


def test_other_settings_damage_and_files_are_refused(tmp_path):
    study = ResumableStudy(tmp_path / "s", {"points": 3})
    study.save_case("a", {"x": 1})
    with pytest.raises(InvalidInput, match=r"which holds a study with points 3; expected points 4"):
        ResumableStudy(tmp_path / "s", {"points": 4})
    (tmp_path / "s" / "cases" / "a.json").write_text('{"x":')
    with pytest.raises(RecordingError, match=r"a\.json: unreadable.*delete it"):
        study.load_case("a")
    (tmp_path / "file").write_text("")
    with pytest.raises(InvalidInput, match="a file; expected a folder"):
        ResumableStudy(tmp_path / "file", {})
    with pytest.raises(InvalidInput, match="which cannot be written"):  # and not after the first case
        ResumableStudy(tmp_path / ("x" * 300), {})


def test_what_is_not_a_number_does_not_lose_a_case(tmp_path):
    study = ResumableStudy(tmp_path, {"study": "s"})
    results = study.run({"a": lambda: {"seen": math.nan, "all": [1.0, math.inf]}})
    assert results == {"a": {"seen": None, "all": [1.0, None]}}


def test_settings_are_those_that_are_read_again(tmp_path):
    """JSON makes lists of tuples: a study of several motions could not go on."""
    for _ in range(2):
        assert ResumableStudy(tmp_path, {"motions": ("swing", "fold")}).run({"a": lambda: {"x": 1}}) == {"a": {"x": 1}}
    with pytest.raises(InvalidInput, match="which holds a study with motions"):
        ResumableStudy(tmp_path, {"motions": ("swing",)})
