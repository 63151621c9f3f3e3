"""Studies on disk: what is finished is never done twice, and other settings are refused."""

import pytest

from torchcloth.errors import InvalidInput, RecordingError
from torchcloth.training.kept import Kept


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
        Kept(tmp_path / "s", {"points": 3}).run(cases)
    found = Kept(tmp_path / "s", {"points": 3}).run(cases)
    assert called == ["a", "b", "c", "c", "d"]
    assert found == {name: {"name": name, "value": 0.1 + 0.2} for name in "abcd"}  # exact: JSON keeps doubles
    assert "4/4 d" in capsys.readouterr().out


def test_nothing_is_written_before_a_case_is_finished(tmp_path):
    assert Kept(tmp_path / "s", {}).find("a") is None
    with pytest.raises(ValueError, match=r"NaN|nan|JSON"):
        Kept(tmp_path / "s", {}).keep("a", {"value": float("nan")})
    assert Kept(tmp_path / "s", {}).find("a") is None


def test_other_settings_damage_and_files_are_refused(tmp_path):
    kept = Kept(tmp_path / "s", {"points": 3})
    kept.keep("a", {"x": 1})
    with pytest.raises(InvalidInput, match=r"which holds a study with points 3; expected points 4"):
        Kept(tmp_path / "s", {"points": 4})
    (tmp_path / "s" / "cases" / "a.json").write_text('{"x":')
    with pytest.raises(RecordingError, match=r"a\.json: unreadable.*delete it"):
        kept.find("a")
    (tmp_path / "file").write_text("")
    with pytest.raises(InvalidInput, match="a file; expected a folder"):
        Kept(tmp_path / "file", {})
