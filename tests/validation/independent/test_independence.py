"""The independent engine imports nothing of the physics that it judges.

Its table of effects takes names, units and typical amplitudes from the library's catalogue of causes: these numbers say
what is hidden, not how cloth moves.
"""

import ast
from pathlib import Path

import pytest
from helpers.import_checks import VALIDATION, find_forbidden_imports

from torchcloth.training.validation import independent
from torchcloth.training.validation.independent import effects

PACKAGE = f"{VALIDATION}.independent"
SOURCES = sorted(Path(independent.__file__).parent.glob("*.py"))
SIZES = "torchcloth.diagnosis.causes.catalogue.CATALOGUE"  # allowed in effects.py only


def test_there_are_sources():
    assert {"scene.py", "mujoco_cloth.py", "generate.py"} <= {path.name for path in SOURCES}


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.name)
def test_only_the_allowed_rooms_are_imported(path):
    allowed = [SIZES] if path.name == "effects.py" else []
    assert find_forbidden_imports(path.read_text(encoding="utf-8"), PACKAGE) == allowed


def test_only_names_and_sizes_of_causes_are_used():
    """Calling a hypothesis' ``apply`` would change a world of the library's."""
    tree = ast.parse(Path(effects.__file__).read_text(encoding="utf-8"))
    used = {n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute) and getattr(n.value, "id", "") == "cause"}
    assert used == {"unit", "typical"}


@pytest.mark.parametrize(
    "source",
    [
        "import torchcloth",
        "import torchcloth.cloth as c",
        "from torchcloth import materials",
        "from torchcloth import *",
        "from torchcloth.materials import AEP",
        "from torchcloth.robotsx import a",
        "from ..verification import scenes",
        "from .. import verification",
        "from ... import studies",
        "import importlib\nimportlib.import_module('torchcloth.cloth')",
        "def f():\n    from torchcloth.meshes import rectangle",
    ],
)
def test_the_check_sees_what_is_forbidden(source):
    assert find_forbidden_imports(source, PACKAGE)


@pytest.mark.parametrize(
    "source",
    [
        "from torchcloth import observe, robots",
        "from torchcloth.errors import InvalidInput\nimport mujoco",
        "from .scene import Scene\nfrom . import motions\nfrom ..independent import sensor",
    ],
)
def test_the_check_lets_pass_what_is_allowed(source):
    assert not find_forbidden_imports(source, PACKAGE)
