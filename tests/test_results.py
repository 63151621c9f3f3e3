"""docs/reference/results.md names every key that is written, and the JSON Schemas describe the files that have one."""

import ast
import importlib.util
import json
import re
from pathlib import Path

import pytest
from helpers.schema_checks import check_written, find_undocumented_keys
from jsonschema import Draft202012Validator

from torchcloth.diagnosis import Fault, refuse
from torchcloth.recordings.scene import NOMINAL_BOUNDS, NOMINAL_UNITS_KEY
from torchcloth.schemas import SCHEMA_NAMES, check_structure, list_keys, load_schema

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "reference" / "results.md").read_text(encoding="utf-8")
WRITTEN = {
    "identification.json": "identification/result.py",
    "prediction.json": "identification/episode_prediction.py",
    "pose.json": "pose/result.py",
    "plan.json": "planning/result.py",
    "confirmation.json": "diagnosis/confirmation.py",
    "inspection.json": "inspection/inspect_recording.py",
}


def keys(path: str) -> set[str]:
    """Of the largest dictionary that ``as_dict`` of the file makes."""
    tree = ast.parse((ROOT / "torchcloth" / path).read_text(encoding="utf-8"))
    (function,) = (n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef) and n.name == "as_dict")
    largest = max((n for n in ast.walk(function) if isinstance(n, ast.Dict)), key=lambda n: len(n.keys))
    return {key.value for key in largest.keys if isinstance(key, ast.Constant)}


def named(file: str) -> set[str]:
    """Keys of the file's schema, else those in the first column of its table."""
    section = PAGE.split(f"## {file}\n")[1].split("\n## ")[0]
    if f"<!-- table: {file} -->" in section:
        return set(list_keys(file.removesuffix(".json")))
    rows = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
    return {key for row in rows for key in re.findall(r"`(\w+)`", row)}


def properties(node, path=""):
    """(path, property) of everything that a schema describes."""
    for key, child in node.get("properties", {}).items():
        yield f"{path}.{key}", child
    for key, child in node.items():
        if isinstance(child, dict):
            yield from properties(child, f"{path}.{key}")


@pytest.mark.parametrize("file", WRITTEN)
def test_every_key_is_on_the_page_and_no_other(file):
    assert named(file) == keys(WRITTEN[file])
    assert len(named(file)) > 3


@pytest.mark.parametrize("name", SCHEMA_NAMES)
def test_a_schema_is_valid_and_says_what_everything_means(name):
    schema = load_schema(name)
    Draft202012Validator.check_schema(schema)
    described = list(properties(schema))
    assert len(described) > 10
    for path, node in described:
        assert node.get("description"), path
        assert "unit" in node or not {"number"} & {*([node["type"]] if isinstance(node.get("type"), str) else [])}, path


@pytest.mark.parametrize("name", SCHEMA_NAMES)
def test_the_pages_have_a_table_of_every_part(name):
    page = PAGE if name != "episode" else (ROOT / "docs" / "reference" / "episode.md").read_text(encoding="utf-8")
    spec = importlib.util.spec_from_file_location("hooks", ROOT / "docs" / "hooks.py")
    hooks = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hooks)
    filled = hooks.on_page_markdown(page, None, None, None)
    assert "<!-- table" not in filled
    for key in list_keys(name):
        assert f"| `{key}`" in filled
    in_rows = {"amplitude"}  # two or three keys, which rows of other tables repeat
    for definition in load_schema(name).get("$defs", {}).keys() - in_rows:
        assert f"<!-- table: {name}.json#{definition} -->" in page


def test_the_schema_and_the_reader_know_the_same_data_sheet():
    assert list_keys("episode", "cloth", "nominal") == [*NOMINAL_BOUNDS, NOMINAL_UNITS_KEY]
    nominal = load_schema("episode")["properties"]["cloth"]["properties"]["nominal"]["properties"]
    for key, bounds in NOMINAL_BOUNDS.items():
        assert nominal[key]["maximum"] == bounds["maximum"]
        assert nominal[key].get("exclusiveMinimum", nominal[key].get("minimum")) == 0


def test_the_shipped_episode_and_the_page_s_follow_the_schema():
    shipped = (ROOT / "torchcloth" / "examples" / "bimanual_swing" / "episode.json").read_text(encoding="utf-8")
    page = (ROOT / "docs" / "reference" / "episode.md").read_text(encoding="utf-8")
    for text in (shipped, re.search(r"```json\n(.*?)```", page, re.DOTALL)[1]):
        check_structure(json.loads(text), "episode")
    assert find_undocumented_keys(json.loads(text), "episode") == []


def test_a_refused_diagnosis_follows_the_schema():
    check_written(refuse([Fault("e1", "no points", "record them")], ["swing"]).content, "diagnosis")


PLAN = {
    "schema": "torchcloth.plan/1",
    "distance": {"before": [0.1], "after": [0.02], "unit": "m"},
    "distance_history": [0.1, 0.02],
    "path_change": {"left": 0.1},
    "nearest_limit": {"fraction": 0.5, "limit": "speed"},
    "nearest_solids": "",
    "stop_reason": "it converged",
    "seconds": 1.0,
    "episode": "episode",
    "convention": "SI",
    "warnings": [],
}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"schema": "torchcloth.plan/2"}, "schema 'torchcloth.plan/2' where 'torchcloth.plan/1' should be"),
        ({"seconds": "long"}, "seconds 'long' where a number should be"),
        ({"seconds": -1.0}, "seconds -1.0 where a number >= 0 should be"),
        ({"distance": {"before": [0.1], "unit": "m"}}, "no 'after' in distance"),
        ({"path_change": {"left": None}}, "path_change.left None where a number should be"),
        ({"warnings": "none"}, "warnings 'none' where a list should be"),
    ],
)
def test_a_difference_is_one_line_with_place_value_and_what_was_expected(change, message):
    check_structure(PLAN, "plan")
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        check_structure({**PLAN, **change}, "plan")
    with pytest.raises(ValueError, match=r"^no 'seconds'$"):
        check_structure({key: value for key, value in PLAN.items() if key != "seconds"}, "plan")
    assert find_undocumented_keys({**PLAN, "extra": 1}, "plan") == ["extra"]
