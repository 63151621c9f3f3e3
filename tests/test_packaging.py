"""The wheel puts exactly one name into site-packages, with all packages and data inside, and works from there.

Built from a copy of the tree, so that no build/ or egg-info is left in the repository.
"""

import os
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = {
    "torchcloth": "torchcloth",
    "torchcloth.benchmarks": "benchmarks",
    "torchcloth.robots": "robots",
    "torchcloth.training": "training",
}
EXAMPLES = ROOT / "torchcloth" / "examples"


def call(*command: str | Path, **options) -> str:
    """Standard output of a command that must succeed."""
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True, **options)
    assert done.returncode == 0, f"{' '.join(map(str, command))}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def tree() -> list[Path]:
    """Files of the repository, relative: what git tracks or would track; outside git, all but hidden and built ones."""
    try:
        names = call("git", "ls-files", "-coz", "--exclude-standard", cwd=ROOT).split("\0")
        return [Path(name) for name in names if name and (ROOT / name).is_file()]
    except (AssertionError, FileNotFoundError):
        skipped = {"__pycache__", "build", "dist", "out"}
        files = (file.relative_to(ROOT) for file in ROOT.rglob("*") if file.is_file())
        return [
            f for f in files if not any(p in skipped or p.startswith(".") or p.endswith(".egg-info") for p in f.parts)
        ]


def build(source: Path, out: Path) -> Path:
    """The wheel of a source tree or sdist, with the setuptools of this environment."""
    flags = ("--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--disable-pip-version-check")
    call(sys.executable, "-m", "pip", "wheel", *flags, "--wheel-dir", out, source)
    (wheel,) = out.glob("*.whl")
    return wheel


@pytest.fixture(scope="module")
def copy(tmp_path_factory) -> Path:
    """The repository's files in a folder of their own."""
    folder = tmp_path_factory.mktemp("source") / "torchcloth"
    for name in tree():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, folder / name)
    return folder


@pytest.fixture(scope="module")
def wheel(copy, tmp_path_factory) -> Path:
    """The wheel built from the tree."""
    return build(copy, tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def inside(wheel) -> set[str]:
    """Names of the files in the wheel."""
    with zipfile.ZipFile(wheel) as archive:
        return {name for name in archive.namelist() if not name.endswith("/")}


def declared() -> dict:
    """The table [tool.setuptools] of pyproject.toml."""
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]


def packages() -> set[str]:
    """Packages in the tree: folders with an __init__.py, under the names they are installed as."""
    found = set()
    for name, folder in FOLDERS.items():
        for file in (ROOT / folder).rglob("__init__.py"):
            found.add(".".join((name, *file.parent.relative_to(ROOT / folder).parts)))
    return found


def test_every_package_is_listed_and_no_other():
    assert declared()["package-dir"] == FOLDERS
    assert set(declared()["packages"]) == packages()


def test_one_top_level_name(inside):
    top = {name.partition("/")[0] for name in inside}
    assert {name for name in top if not name.endswith(".dist-info")} == {"torchcloth"}
    assert len(top) == 2


def test_all_modules_are_inside_and_nothing_else(inside):
    expected = set()
    for package in packages():
        base = next(name for name in sorted(FOLDERS, key=len, reverse=True) if (package + ".").startswith(name + "."))
        folder = ROOT.joinpath(FOLDERS[base], *package[len(base) :].strip(".").split("."))
        expected |= {f"{package.replace('.', '/')}/{file.name}" for file in folder.glob("*.py")}
    assert {name for name in inside if name.endswith(".py")} == expected
    folders = {part for name in inside for part in name.split("/")[:-1]}
    assert not folders & {"tests", "notebooks", "docs", "build"}


def test_data_is_inside(inside):
    urdf = {f"torchcloth/robots/urdf/{file.name}" for file in (ROOT / "robots" / "urdf").glob("*.urdf")}
    assert len(urdf) >= 3
    engine = {file.relative_to(ROOT).as_posix() for file in (ROOT / "torchcloth/engine/csrc").rglob("*.[ch]*")}
    assert {"torchcloth/engine/csrc/run.h", "torchcloth/engine/csrc/engine.cpp"} <= engine
    assert urdf | engine | {"torchcloth/py.typed", "torchcloth/materials/fabrics.csv"} <= inside
    assert any(name.endswith("licenses/LICENSE") for name in inside)


def test_examples_are_inside(inside):
    files = {f.as_posix() for f in tree() if f.is_relative_to("torchcloth/examples") and f.suffix != ".py"}
    assert files
    assert files <= inside


def test_command_is_inside(wheel, inside):
    """The console script points to a module that is shipped."""
    with zipfile.ZipFile(wheel) as archive:
        (entry,) = [name for name in inside if name.endswith("dist-info/entry_points.txt")]
        scripts = archive.read(entry).decode()
    assert "torchcloth = torchcloth.cli:main" in scripts
    assert "torchcloth/cli/__init__.py" in inside


USE = """
import importlib.resources as resources
import sys
import torchcloth, torchcloth.benchmarks, torchcloth.robots, torchcloth.recordings, torchcloth.training
for module in (torchcloth, torchcloth.benchmarks, torchcloth.robots, torchcloth.training):
    print(module.__file__)
assert resources.files("torchcloth.robots").joinpath("urdf", "rizon4.urdf").is_file()
arm = torchcloth.robots.load("rizon4")
examples = resources.files("torchcloth").joinpath("examples")
for folder in sorted(examples.iterdir(), key=str):
    torchcloth.recordings.read(folder)
"""


def test_it_works_from_the_wheel(wheel, tmp_path):
    """Imported from the unpacked wheel, not from the editable install or the working folder."""
    unpacked, elsewhere = tmp_path / "unpacked", tmp_path / "elsewhere"
    elsewhere.mkdir()
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(unpacked)
    out = call(sys.executable, "-c", USE, cwd=elsewhere, env={**os.environ, "PYTHONPATH": str(unpacked)})
    places = [Path(line).parent.relative_to(unpacked).as_posix() for line in out.splitlines()]
    assert places == ["torchcloth", "torchcloth/benchmarks", "torchcloth/robots", "torchcloth/training"]


def test_the_engine_came_along(wheel, inside, tmp_path):
    """Where there is a compiler, the wheel holds the library for this processor, and takes that one."""
    from torchcloth.engine import building

    try:
        building.compiler()
    except building.EngineUnavailable as miss:
        pytest.skip(str(miss))
    built = f"torchcloth/engine/built/{building.file_name()}"
    assert {name for name in inside if name.startswith("torchcloth/engine/built/")} == {built}
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path)
    use = "from torchcloth.engine import library; library.library(); print(library.status())"
    said = call(sys.executable, "-c", use, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(tmp_path)})
    assert said.strip() == f"built: {tmp_path / built}"


def test_companions_refuse_another_name():
    """``import robots`` in a checkout is a mistake that would load a second copy."""
    for folder in ("benchmarks", "robots", "training"):
        done = subprocess.run([sys.executable, "-c", f"import {folder}"], cwd=ROOT, capture_output=True, text=True)
        assert done.returncode != 0
        assert f"import this package as torchcloth.{folder}" in done.stderr


@pytest.mark.slow
def test_the_sdist_makes_the_same_wheel(copy, inside, tmp_path):
    code = f"from setuptools.build_meta import build_sdist; build_sdist({str(tmp_path)!r})"
    call(sys.executable, "-c", code, cwd=copy)
    (sdist,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        assert any(name.endswith("robots/urdf/rizon4.urdf") for name in archive.getnames())
    with zipfile.ZipFile(build(sdist, tmp_path / "wheel")) as archive:
        assert {name for name in archive.namelist() if not name.endswith("/")} == inside
