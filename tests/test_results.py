"""docs/reference/results.md names every key that is written."""

import ast
import re
from pathlib import Path

import pytest

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
    """Keys in the first column of a file's table."""
    section = PAGE.split(f"## {file}\n")[1].split("\n## ")[0]
    rows = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
    return {key for row in rows for key in re.findall(r"`(\w+)`", row)}


@pytest.mark.parametrize("file", WRITTEN)
def test_every_key_is_on_the_page_and_no_other(file):
    assert named(file) == keys(WRITTEN[file])
    assert len(named(file)) > 3
