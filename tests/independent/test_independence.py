"""The truth may not come from the code that it judges: what the modules here import is checked without running them."""

import ast
from pathlib import Path

import pytest

HERE = Path(__file__).parent
ALLOWED = ("torchcloth.robots", "torchcloth.recordings", "torchcloth.observe", "torchcloth.errors", "torchcloth.types")


def forbidden(source: str) -> list[str]:
    """Names of torchcloth modules that the source imports (or might, by name) and may not."""
    names = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            if node.level:
                names.append("." * node.level + (node.module or ""))
            elif node.module == "torchcloth":
                names += [f"torchcloth.{alias.name}" for alias in node.names]
            else:
                names.append(node.module or "")
        elif isinstance(node, ast.Call) and _name(node.func) in ("import_module", "__import__", "exec", "eval"):
            names.append(f".{_name(node.func)}")
    return [name for name in names if not _fine(name)]


def _fine(name: str) -> bool:
    if name.startswith("."):
        return False
    return name.split(".")[0] != "torchcloth" or any(name == a or name.startswith(a + ".") for a in ALLOWED)


def _name(function: ast.expr) -> str:
    return function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")


@pytest.mark.parametrize("path", sorted(HERE.glob("*.py")), ids=lambda path: path.name)
def test_only_the_allowed_rooms_are_imported(path):
    assert forbidden(path.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    "source",
    [
        "import torchcloth",
        "import torchcloth.cloth as c",
        "from torchcloth import materials",
        "from torchcloth import *",
        "from torchcloth.materials import AEP",
        "from torchcloth.robotsx import a",
        "from ..physics import x",
        "import importlib\nimportlib.import_module('torchcloth.cloth')",
        "def f():\n    from torchcloth.meshes import rectangle",
    ],
)
def test_the_check_sees_what_is_forbidden(source):
    assert forbidden(source)


def test_the_check_lets_pass_what_is_allowed():
    assert not forbidden(
        "from torchcloth import observe, robots\nfrom torchcloth.errors import InvalidInput\nimport mujoco"
    )
