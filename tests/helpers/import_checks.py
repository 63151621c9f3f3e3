"""Imports of a source, read without running it: the truth may not come from the code that it tests."""

import ast
from collections.abc import Sequence

VALIDATION = "torchcloth.training.validation"
ALLOWED_PACKAGES = (
    "torchcloth.robots",
    "torchcloth.recordings",
    "torchcloth.observe",
    "torchcloth.errors",
    "torchcloth.types",
    "torchcloth._utils.constants",
    f"{VALIDATION}.independent",
)


def find_forbidden_imports(source: str, package: str, allowed: Sequence[str] = ALLOWED_PACKAGES) -> list[str]:
    """Return what a module of ``package`` imports of torchcloth, or might import by name, and may not.

    Relative imports are resolved. Dynamic imports count as forbidden, with a dot before their name.
    """
    names = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            parents = package.split(".")[: 1 - node.level or None] if node.level else []
            base = ".".join([*parents, *([node.module] if node.module else [])])
            names += [f"{base}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Call) and _name(node.func) in ("import_module", "__import__", "exec", "eval"):
            names.append(f".{_name(node.func)}")
    return [name for name in names if not _is_allowed(name, allowed)]


def _is_allowed(name: str, allowed: Sequence[str]) -> bool:
    if name.startswith("."):
        return False
    return name.split(".")[0] != "torchcloth" or any(name == a or name.startswith(a + ".") for a in allowed)


def _name(function: ast.expr) -> str:
    return function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
