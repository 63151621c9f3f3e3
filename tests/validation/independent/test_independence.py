"""The independent engine imports nothing of the physics that it judges."""

from pathlib import Path

import pytest
from helpers.import_checks import VALIDATION, forbidden_imports

from torchcloth.training.validation import independent

PACKAGE = f"{VALIDATION}.independent"
SOURCES = sorted(Path(independent.__file__).parent.glob("*.py"))


def test_there_are_sources():
    assert {"scene.py", "mujoco_cloth.py", "generate.py"} <= {path.name for path in SOURCES}


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.name)
def test_only_the_allowed_rooms_are_imported(path):
    assert forbidden_imports(path.read_text(encoding="utf-8"), PACKAGE) == []


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
    assert forbidden_imports(source, PACKAGE)


@pytest.mark.parametrize(
    "source",
    [
        "from torchcloth import observe, robots",
        "from torchcloth.errors import InvalidInput\nimport mujoco",
        "from .scene import Scene\nfrom . import motions\nfrom ..independent import sensor",
    ],
)
def test_the_check_lets_pass_what_is_allowed(source):
    assert not forbidden_imports(source, PACKAGE)
