"""How the code is written (docs/development/style.md): what can be checked by reading the sources."""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("torchcloth", "robots", "training", "benchmarks")
MAX_README_LINES = 170
MIN_DOCSTRING_WORDS = 4

# Identifiers that say nothing about what they name.
FORBIDDEN_IDENTIFIERS = frozenset(("lost", "told", "found", "kept", "held", "own", "beside", "alike", "doubts"))

# First words of public docstrings. A verb that is missing is welcome here.
_VERBS = """
Accept Adapt Add Advance Align Allocate Annotate Append Apply Archive Arrange Ask Assemble Assign Attach
Average Begin Bind Bound Bring Broadcast Build Calibrate Call Cancel Capture Carry Cast Change Check Choose
Clamp Clear Clip Clone Close Collapse Collect Combine Compare Compile Complete Compose Compute Concatenate
Configure Connect Construct Continue Convert Copy Correct Count Create Crop Cut Decide Declare Decode Delete
Demand Derive Describe Detect Determine Diagnose Differentiate Disable Discard Display Distribute Divide
Download Draw Drive Drop Dump Emit Enable Encode End Ensure Enumerate Estimate Evaluate Exchange Exclude
Execute Expand Explain Export Expose Extend Extract Extrapolate Fetch Fill Filter Find Finish Fit Flag Flatten
Flush Fold Follow Format Forward Freeze Gather Generate Get Give Group Handle Hide Identify Ignore Import
Include Increase Inflate Initialise Insert Inspect Install Integrate Interpolate Invert Iterate Join Keep
Label Launch Lay Learn Leave Let Lift Limit Linearise Link List Load Locate Log Lower Make Map Mark Mask Match
Maximise Measure Merge Minimise Mirror Move Multiply Name Normalise Number Observe Omit Open Optimise Overlay
Pad Parse Partition Perform Perturb Pick Place Plan Play Plot Predict Prepare Print Process Produce Project
Propagate Propose Prune Pull Push Put Quantify Raise Read Rebuild Recompute Record Reduce Refine Refit Refuse
Register Reject Relax Release Reload Remove Rename Render Renumber Reorder Repeat Replace Replay Report
Require Resample Reserve Reset Reshape Resolve Restart Restore Restrict Resume Retrieve Return Reverse
Reweight Rotate Round Run Sample Save Say Scale Scan Scatter Schedule Score Screen Search See Segment Select
Send Serialise Set Settle Sew Shade Shake Shift Show Shrink Shuffle Simplify Simulate Skip Slice Smooth Solve
Sort Specify Spill Split Stack Standardise Start Step Stop Store Stream Stretch Subdivide Submit Subtract
Suggest Sum Summarise Suppress Swap Swing Switch Take Tell Terminate Test Time Trace Track Train Transfer
Transform Translate Transpose Triangulate Truncate Try Turn Undo Unfold Unpack Unwrap Update Upgrade Use
Validate Vary Verify Visualise Wait Walk Warn Weigh Weld Whiten Widen Wrap Write Yield
"""
IMPERATIVES = frozenset(_VERBS.split())
AFTER_NOUNS = ("of", "->", "=")  # second words that make a noun of "Change" or "Name"


class Source(NamedTuple):
    """A parsed file of the repository."""

    path: str
    text: str
    tree: ast.Module


@cache
def sources() -> tuple[Source, ...]:
    """All Python files of the library and its companions."""
    files = sorted(file for folder in FOLDERS for file in (ROOT / folder).rglob("*.py"))
    texts = [(file.relative_to(ROOT).as_posix(), file.read_text(encoding="utf-8")) for file in files]
    return tuple(Source(path, text, ast.parse(text)) for path, text in texts)


def constants(tree: ast.Module) -> Iterator[tuple[int, str, ast.expr]]:
    """Line, name and value of every upper-case name that a module assigns at its top level."""
    for node in tree.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.value is not None:
            pairs = [(node.target, node.value)]
        elif isinstance(node, ast.Assign):
            pairs = [pair for target in node.targets for pair in _pairs(target, node.value)]
        else:
            continue
        for target, value in pairs:
            if target.id == target.id.upper() and any(c.isalpha() for c in target.id):
                yield node.lineno, target.id, value


def _pairs(target: ast.expr, value: ast.expr) -> list[tuple[ast.Name, ast.expr]]:
    if isinstance(target, ast.Name):
        return [(target, value)]
    if not isinstance(target, ast.Tuple):
        return []
    values = value.elts if isinstance(value, ast.Tuple) else [value] * len(target.elts)
    return [pair for t, v in zip(target.elts, values, strict=True) for pair in _pairs(t, v)]


def is_number(value: ast.expr) -> bool:
    """Whether an expression is made of numbers alone."""
    if isinstance(value, ast.BinOp):
        return is_number(value.left) and is_number(value.right)
    if isinstance(value, ast.UnaryOp):
        return is_number(value.operand)
    return isinstance(value, ast.Constant) and type(value.value) in (int, float)


def bare_constants(source: Source) -> list[str]:
    """Constants bound to a number whose name is one word, without quantity or role."""
    return [
        f"{source.path}:{line} {name}"
        for line, name, value in constants(source.tree)
        if is_number(value) and "_" not in name.strip("_")
    ]


def ambiguous_constants(files: tuple[Source, ...]) -> list[str]:
    """Constants bound to numbers that two modules define with different values."""
    places: dict[str, dict[str, list[str]]] = {}
    for source in files:
        for line, name, value in constants(source.tree):
            if is_number(value):
                by_value = places.setdefault(name.strip("_"), {})
                by_value.setdefault(ast.unparse(value), []).append(f"{source.path}:{line}")
    return [
        f"{name}: " + ", ".join(f"{value} at {at[0]}" for value, at in by_value.items())
        for name, by_value in sorted(places.items())
        if len(by_value) > 1
    ]


def forbidden_identifiers(source: Source) -> list[str]:
    """Uses of forbidden identifiers: names, arguments, keywords, attributes and definitions."""
    uses = set()
    for node in ast.walk(source.tree):
        name = None
        if isinstance(node, ast.Name):
            name = node.id
        elif isinstance(node, ast.Attribute):
            name = node.attr
        elif isinstance(node, ast.arg | ast.keyword):
            name = node.arg
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            name = node.name
        if name is not None and name.strip("_") in FORBIDDEN_IDENTIFIERS:
            uses.add((node.lineno, name))
    return [f"{source.path}:{line} {name}" for line, name in sorted(uses)]


def public_definitions(body: list[ast.stmt]) -> Iterator[tuple[ast.FunctionDef | ast.ClassDef, bool]]:
    """Public functions, classes and methods of public classes, and whether each is a property."""
    for node in body:
        if isinstance(node, ast.If):  # definitions under TYPE_CHECKING or a version
            yield from public_definitions(node.body)
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) or node.name.startswith("_"):
            continue
        names = {ast.unparse(d).split(".")[-1] for d in node.decorator_list}
        yield node, bool(names & {"property", "cached_property", "setter"})  # type: ignore[misc]
        if isinstance(node, ast.ClassDef):
            yield from public_definitions(node.body)


def short_docstrings(source: Source) -> list[str]:
    """Public docstrings of fewer than four words."""
    short = []
    for node, _ in public_definitions(source.tree.body):
        text = ast.get_docstring(node)
        if text is not None and len(text.split()) < MIN_DOCSTRING_WORDS:
            short.append(f"{source.path}:{node.lineno} {node.name}: {text!r}")
    return short


def docstrings_without_imperative(source: Source) -> list[str]:
    """Docstrings of public functions and methods, not properties, that do not begin with an imperative."""
    wrong = []
    for node, is_property in public_definitions(source.tree.body):
        text = ast.get_docstring(node)
        if isinstance(node, ast.ClassDef) or is_property or not text or node.name.startswith("test_"):
            continue  # the docstring of a test states what must hold
        word, following = [*text.split(), ""][:2]
        if word.rstrip(".,;:") not in IMPERATIVES or following in AFTER_NOUNS:
            wrong.append(f"{source.path}:{node.lineno} {node.name}: {text.splitlines()[0][:60]!r}")
    return wrong


def report(violations: list[str]) -> str:
    """Violations by room, for the message of a failed test."""
    rooms: dict[str, list[str]] = {}
    for line in violations:
        path = re.match(r"[\w./]+", line)
        parts = path.group().split("/") if path and "/" in path.group() else ["everywhere"]
        rooms.setdefault("/".join(parts[:2]) if len(parts) > 2 else parts[0], []).append(line)
    blocks = (f"{room}: {len(lines)}\n  " + "\n  ".join(lines) for room, lines in sorted(rooms.items()))
    return f"{len(violations)} violations\n" + "\n".join(blocks)


def test_no_constant_is_named_by_one_word():
    violations = [line for source in sources() for line in bare_constants(source)]
    assert not violations, report(violations)


def test_a_constant_name_has_one_value_everywhere():
    violations = ambiguous_constants(sources())
    assert not violations, report(violations)


def test_no_lambda_is_bound_to_a_name():
    violations = [
        f"{source.path}:{number}"
        for source in sources()
        for number, line in enumerate(source.text.splitlines(), 1)
        if re.search(r"noqa:[^#]*E731", line)
    ]
    assert not violations, report(violations)


def test_no_identifier_is_forbidden():
    violations = [line for source in sources() for line in forbidden_identifiers(source)]
    assert not violations, report(violations)


def test_public_docstrings_say_something():
    violations = [line for source in sources() for line in short_docstrings(source)]
    assert not violations, report(violations)


def test_docstrings_of_functions_begin_with_an_imperative():
    violations = [line for source in sources() for line in docstrings_without_imperative(source)]
    assert not violations, report(violations)


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= MAX_README_LINES


def parse(text: str, path: str = "torchcloth/room/file.py") -> Source:
    return Source(path, text, ast.parse(text))


@pytest.mark.parametrize(
    ("check", "wrong", "right"),
    [
        (bare_constants, "LEAST = 3", "MIN_VISIBLE_DISPLACEMENT_M = 3"),
        (bare_constants, "_FEW, MAX_COUNT = -1, 2.0 ** 3", "DEVICES = ('cpu',)"),
        (forbidden_identifiers, "def f(x):\n    found = x", "def f(x):\n    result = x  # what was found"),
        (forbidden_identifiers, "f(held=1)", "f(gripped=1)"),
        (forbidden_identifiers, "self.told", "self.description"),
        (short_docstrings, 'def f():\n    """The same."""', 'def _f():\n    """The same."""'),
        (short_docstrings, 'class A:\n    """Options."""', 'class A:\n    """Options of the command line."""'),
        (
            docstrings_without_imperative,
            'def f():\n    """Whether it is so."""',
            'def f():\n    """Return it all now."""',
        ),
        (
            docstrings_without_imperative,
            'def f():\n    """Returns the sum."""',
            'class A:\n    """A thing with parts."""',
        ),
        (
            docstrings_without_imperative,
            'class A:\n    def f(self):\n        """The sum."""',
            'class A:\n    @property\n    def f(self):\n        """The sum."""',
        ),
    ],
)
def test_the_checks_tell_wrong_from_right(check, wrong, right):
    assert len(check(parse(wrong))) == 1
    assert check(parse(right)) == []


def test_a_name_with_two_values_is_ambiguous():
    files = (parse("MIN_COUNT = 3", "a.py"), parse("_MIN_COUNT = 4", "b.py"), parse("MAX_COUNT = 1", "c.py"))
    assert len(ambiguous_constants(files)) == 1
    assert ambiguous_constants((*files[:1], parse("MIN_COUNT = 3", "d.py"))) == []
