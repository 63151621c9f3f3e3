"""Every file imports from its own package or from a level below; packages of one level do not import each other.

A package here is a module or folder directly under ``torchcloth`` (benchmarks/, robots/, training/ are packages too, ""
is the package itself). Imports inside functions and under TYPE_CHECKING count: a circle is one when the code runs, and
to a reader. Inside a package there is no circle of modules either.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
COMPANIONS = ("benchmarks", "robots", "training")  # folders of their own, installed as torchcloth.robots, ...

LEVELS = (
    ("errors",),
    ("_utils", "schemas"),
    ("types", "parameters", "meshes"),
    ("materials", "effects", "boundaries", "recordings"),
    ("dynamics",),
    ("engine",),
    ("losses", "simulation"),
    ("cloth", "observe", "robots"),
    ("inspection",),
    ("episodes", "testing"),
    ("identification",),
    ("pose",),
    ("diagnosis",),
    ("planning",),
    ("authoring", "export", "synthesis", "viewing"),
    ("",),  # torchcloth/__init__.py: the names a user sees
    ("training",),
    ("benchmarks",),
    ("cli",),
    ("__main__",),
)

# Packages that must know less than their level allows.
ONLY = {
    "robots": {"errors", "types", "recordings", "_utils"},  # tensors cross to the cloth, nothing else
    "recordings": {"errors", "_utils", "schemas", "types", "meshes"},  # an episode can be read without any physics
    "observe": {"errors", "meshes", "losses"},  # it sees where cloth is, and knows nothing of how it moves
}

# (file, package): reason. An entry that is no longer needed fails the test.
EXCEPTIONS: dict[tuple[str, str], str] = {}


def level_of(package: str) -> int:
    for number, packages in enumerate(LEVELS):
        if package in packages:
            return number
    raise AssertionError(f"package {package!r} is on no level: place it in LEVELS, above all that it imports")


def sources() -> dict[str, Path]:
    """Files by dotted name, as installed: {"torchcloth.robots.arm": robots/arm.py}; packages end in ".__init__"."""
    files = {}
    for folder in ("torchcloth", *COMPANIONS):
        prefix = ("torchcloth", folder) if folder in COMPANIONS else (folder,)
        for file in sorted((ROOT / folder).rglob("*.py")):
            files[".".join((*prefix, *file.relative_to(ROOT / folder).with_suffix("").parts))] = file
    return files


SOURCES = sources()
NAMES = {name.removesuffix(".__init__") for name in SOURCES}


def package_of(name: str) -> str:
    """Package of a dotted name: torchcloth.robots.arm -> robots, torchcloth.__init__ -> ""."""
    part = [*name.split("."), ""][1]
    return "" if part == "__init__" else part


def imported(name: str, tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and dotted name of every import of the package in the file called ``name``."""
    package = name.split(".")[:-1]
    for node in ast.walk(tree):
        targets = []
        if isinstance(node, ast.Import):
            targets = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            start = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*start, *([node.module] if node.module else [])])
            names = [f"{base}.{alias.name}" for alias in node.names]
            targets = [n if n in NAMES else base for n in names]
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            called = getattr(node.func, "id", getattr(node.func, "attr", None))
            target = node.args[0].value
            if called in ("import_module", "__import__") and isinstance(target, str):
                dots = len(target) - len(target.lstrip("."))
                start = package[: len(package) - dots + 1] if dots else []
                targets = [".".join([*start, *filter(None, [target.lstrip(".")])])]
        yield from ((getattr(node, "lineno", 0), n) for n in targets if n.split(".")[0] == "torchcloth")


def violations(name: str, text: str) -> list[tuple[int, str, str]]:
    """(line, package, why) for every import in this source that its level does not allow."""
    home = package_of(name)
    bad = []
    for line, target in imported(name, ast.parse(text)):
        package = package_of(target)
        if package == home:
            continue
        if level_of(package) >= level_of(home):
            bad.append((line, package, "sibling" if level_of(package) == level_of(home) else "level above"))
        elif home in ONLY and package not in ONLY[home]:
            bad.append((line, package, f"{home} may import only {sorted(ONLY[home])}"))
    return bad


def test_every_room_has_one_level_of():
    packages = [package for level in LEVELS for package in level]
    assert len(packages) == len(set(packages))
    for name in SOURCES:
        level_of(package_of(name))


def test_imports_go_down():
    wrong, used = [], set()
    for name, file in SOURCES.items():
        path = file.relative_to(ROOT).as_posix()
        for line, package, why in violations(name, file.read_text(encoding="utf-8")):
            if (path, package) in EXCEPTIONS:
                used.add((path, package))
            else:
                wrong.append(f"{path}:{line} imports torchcloth{package and '.'}{package} ({why})")
    assert not wrong, "\n" + "\n".join(wrong)
    assert used == set(EXCEPTIONS), f"exceptions no longer needed: {set(EXCEPTIONS) - used}"


def circles(graph: dict[str, set[str]]) -> list[set[str]]:
    """Strongly connected components of more than one module (Tarjan 1972)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    components = []

    def visit(module: str) -> None:
        index[module] = low[module] = len(index)
        stack.append(module)
        for target in graph[module]:
            if target not in index:
                visit(target)
                low[module] = min(low[module], low[target])
            elif target in stack:
                low[module] = min(low[module], index[target])
        if low[module] == index[module]:
            component = set(stack[stack.index(module) :])
            del stack[stack.index(module) :]
            if len(component) > 1:
                components.append(component)

    for module in graph:
        if module not in index:
            visit(module)
    return components


def imports_within(package: str) -> dict[str, set[str]]:
    """Modules of a package, and those of the same package that each imports."""
    files = {name.removesuffix(".__init__"): name for name in SOURCES if package_of(name) == package}
    return {
        module: {
            target
            for _, target in imported(name, ast.parse(SOURCES[name].read_text(encoding="utf-8")))
            if target in files and target != module
        }
        for module, name in files.items()
    }


@pytest.mark.parametrize("package", [package for level in LEVELS for package in level])
def test_no_circle_inside_a_package(package):
    components = circles(imports_within(package))
    assert not components, "\n".join(" <-> ".join(sorted(circle)) for circle in components)


def test_a_circle_is_seen():
    graph = {"a": {"b"}, "b": {"c"}, "c": {"b", "d"}, "d": set(), "e": {"a"}}
    assert circles(graph) == [{"b", "c"}]
    assert circles({"a": {"b"}, "b": set()}) == []


def test_the_walk_sees_the_house():
    """It reads files, and resolves imports that are known to be there."""
    assert {"", "cloth", "materials", "robots", "training"} <= {package_of(name) for name in SOURCES}
    packages = {
        package_of(target)
        for _, target in imported("torchcloth.cloth", ast.parse(SOURCES["torchcloth.cloth"].read_text()))
    }
    assert {"dynamics", "materials", "boundaries"} <= packages


@pytest.mark.parametrize(
    ("name", "text", "package"),
    [
        ("torchcloth.meshes.mesh", "from ..cloth import Cloth", "cloth"),
        ("torchcloth.effects.air", "from ..materials import AEP", "materials"),
        ("torchcloth.effects.__init__", "from .. import materials", "materials"),
        ("torchcloth.dynamics.substep", "def f():\n    from ..cloth import Cloth", "cloth"),
        ("torchcloth.dynamics.substep", "from .. import cloth", "cloth"),
        ("torchcloth.dynamics.substep", "import torchcloth.cloth as c", "cloth"),
        ("torchcloth.cloth", "from torchcloth import robots", "robots"),
        ("torchcloth.cloth", "from torchcloth import Rollout", ""),
        ("torchcloth.cloth", "import torchcloth as tc", ""),
        ("torchcloth.cloth", "importlib.import_module('torchcloth.robots')", "robots"),
        ("torchcloth.cloth", "import_module('.robots', __package__)", "robots"),
        ("torchcloth.robots.arm", "from torchcloth.dynamics.substep import rollout", "dynamics"),
        ("torchcloth.robots.arm", "if TYPE_CHECKING:\n    from torchcloth.cloth import Cloth", "cloth"),
        ("torchcloth.observe.render", "from ..dynamics.substep import step", "dynamics"),
        ("torchcloth.training.fit", "from torchcloth.cli import main", "cli"),
        ("torchcloth.__init__", "from . import training", "training"),
    ],
)
def test_a_wrong_import_is_found(name, text, package):
    assert [target for _, target, _ in violations(name, text)] == [package]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("torchcloth.effects.air", "from .base import AbstractEffect\nfrom ..types import Surface"),
        ("torchcloth.cloth", "from . import dynamics\nfrom .boundaries.motion import drive"),
        ("torchcloth.robots.arm", "from . import inverse\nfrom torchcloth.types import Trajectory"),
        ("torchcloth.training.fit", "import torchcloth as tc\nfrom torchcloth.robots import load"),
        ("torchcloth.errors", "import torch\nfrom importlib import resources"),
    ],
)
def test_a_right_import_passes(name, text):
    assert violations(name, text) == []
