"""Building and finding the library: without a compiler, with a failing one, two at once, and where nobody may write."""

import os
import re
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from torchcloth.engine import building, library
from torchcloth.engine.building import EngineUnavailable

USE = """
import torch, torchcloth as tc
cloth = tc.Cloth(tc.meshes.rectangle(0.2, 0.2, resolution=(3, 3)), tc.materials.AEP(1e5, 0.3), 0.2, contact=None)
for _ in range(2):
    cloth(cloth.rest_state(), times=[0.0, 0.002])
print([line for line in str(cloth).splitlines() if "engine" in line][0])
cloth.engine = "fused"
try:
    cloth(cloth.rest_state(), times=[0.0, 0.002])
except tc.errors.InvalidInput as error:
    print(error)
"""
TINY = 'extern "C" int tc_nothing() { return 0; }\n'


def run(code, **environment):
    """A fresh process; the cache is wherever ``environment`` says."""
    source = str(Path(library.__file__).parents[2])
    paths = os.pathsep.join(filter(None, [source, os.environ.get("PYTHONPATH")]))
    known = {**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1", **environment}
    return subprocess.run([sys.executable, *code], capture_output=True, text=True, env=known)


@pytest.fixture
def nowhere(tmp_path):
    """Neither a built library nor a compiler."""
    for name in ("cache", "home", "tmp", "bin"):
        (tmp_path / name).mkdir()
    return {
        "TORCHCLOTH_CACHE": str(tmp_path / "cache"), "HOME": str(tmp_path / "home"), "TMPDIR": str(tmp_path / "tmp"),
        "XDG_CACHE_HOME": "", "PATH": str(tmp_path / "bin"), "CXX": "",
    }  # fmt: skip


def test_without_a_compiler(nowhere):
    """One warning, the reference's results, and "fused" says what to do."""
    done = run(["-c", USE], **nowhere)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("UserWarning") == 1
    assert "no C++ compiler: simulations run on the torch reference" in done.stderr
    assert "install one (Debian, Ubuntu: apt-get install g++)" in done.stderr
    first, second = done.stdout.splitlines()
    assert first.strip() == "engine: reference (no C++ compiler)"
    assert re.match(r'engine; got "fused"; expected .*no C\+\+ compiler; install one .*engine="auto"', second)


def test_doctor_without_a_compiler(nowhere):
    done = run(["-m", "torchcloth.cli", "doctor"], **nowhere)
    assert done.returncode == 0, done.stderr
    assert re.search(
        r"^engine +not available, the torch reference serves: no C\+\+ compiler; install", done.stdout, re.M
    )


@pytest.mark.slow
def test_doctor_before_and_after_the_first_use(nowhere, tmp_path):
    with_path = {**nowhere, "PATH": os.environ["PATH"]}
    done = run(["-m", "torchcloth.cli", "doctor"], **with_path)
    assert re.search(r"^engine +will be built at first use, with .+", done.stdout, re.M)
    (tmp_path / "cache" / building.file_name()).write_bytes(b"")
    done = run(["-m", "torchcloth.cli", "doctor"], **with_path)
    assert re.search(rf"^engine +built: .*{building.file_name()}$", done.stdout, re.M)


def test_a_compiler_that_fails(nowhere, tmp_path):
    """Its first error is in the warning; it is not tried again."""
    compiler = tmp_path / "bin" / "broken++"
    compiler.write_text(f"#!/bin/sh\necho x >> {tmp_path}/calls\necho 'a.cpp:1: error: no such thing' >&2\nexit 1\n")
    compiler.chmod(0o755)
    done = run(["-c", USE], **{**nowhere, "CXX": str(compiler), "PATH": os.environ["PATH"]})
    assert done.returncode == 0, done.stderr
    assert "failed (exit code 1): a.cpp:1: error: no such thing" in done.stderr
    assert "name a compiler for C++20 in CXX" in done.stderr
    sources = [p for p in building.SOURCES.rglob("*.cpp")]
    assert len((tmp_path / "calls").read_text().split()) <= len(sources) + 1  # and once for its version


def test_a_library_that_does_not_load(nowhere, tmp_path):
    building.store(tmp_path / "cache" / building.file_name(), b"not a library")
    done = run(["-c", USE], **nowhere)
    assert done.returncode == 0, done.stderr
    assert "the engine's library does not load" in done.stderr


# -- with small sources -----------------------------------------------------------------------------------------------


@pytest.fixture
def small(tmp_path, monkeypatch):
    """Sources that compile in no time, and a cache of their own."""
    (tmp_path / "csrc" / "kernels").mkdir(parents=True)
    (tmp_path / "csrc" / "kernels" / "tiny.cpp").write_text(TINY)
    monkeypatch.setattr(building, "SOURCES", tmp_path / "csrc")
    monkeypatch.setenv("TORCHCLOTH_CACHE", str(tmp_path / "cache"))
    return tmp_path


def test_it_is_built_once_with_a_line_about_it(small, capfd):
    assert building.cached() is None
    made = building.build()
    assert made == small / "cache" / building.file_name() == building.cached()
    said = capfd.readouterr().err
    assert re.fullmatch(r"torchcloth: building the engine once with .*, about \d+ s\n", said)
    assert building.build() == made
    assert capfd.readouterr().err == ""
    assert sorted(p.name for p in (small / "cache").iterdir()) == ["building.lock", made.name]


def test_the_name_sees_sources_flags_and_processor(small, monkeypatch):
    names = {building.file_name()}
    (small / "csrc" / "kernels" / "tiny.cpp").write_text(TINY + "// changed\n")
    names.add(building.file_name())
    monkeypatch.setattr(building, "FLAGS", building.FLAGS + " -DX")
    names.add(building.file_name())
    monkeypatch.setenv("TORCHCLOTH_ENGINE_FLAGS", "-DY")
    names.add(building.file_name())
    monkeypatch.setattr(building, "_processor", lambda: "another")
    names.add(building.file_name())
    assert len(names) == 5


@pytest.mark.slow
def test_two_at_once_build_once(small, capfd):
    """Threads stand for processes: the lock is on an open file of each."""
    made = []
    threads = [threading.Thread(target=lambda: made.append(building.build())) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(made) == 3
    assert capfd.readouterr().err.count("building the engine") == 1


@pytest.mark.slow
def test_a_compiler_with_arguments(small, monkeypatch):
    monkeypatch.setenv("CXX", "g++ -DTINY")
    assert building.compiler() == ["g++", "-DTINY"]
    assert building.build().exists()


@pytest.mark.slow
def test_where_home_cannot_be_written_to(small, monkeypatch, tmp_path):
    """A file stands where the folder would be: this also stops root, who may write everywhere."""
    (tmp_path / "taken").write_text("")
    monkeypatch.setenv("TORCHCLOTH_CACHE", str(tmp_path / "taken" / "cache"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "taken"))
    monkeypatch.setattr(building.tempfile, "gettempdir", lambda: str(tmp_path / "tmp"))
    made = building.build()
    assert made.parent.parent == tmp_path / "tmp"
    monkeypatch.setattr(building.tempfile, "gettempdir", lambda: str(tmp_path / "taken"))
    with pytest.raises(EngineUnavailable, match="can be written to") as caught:
        building.build()
    assert "TORCHCLOTH_CACHE" in caught.value.remedy


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="nobody's files here")
def test_somebody_elses_library_in_the_temporary_folder_is_not_loaded(small, monkeypatch, tmp_path):
    monkeypatch.delenv("TORCHCLOTH_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(building.tempfile, "gettempdir", lambda: str(tmp_path / "tmp"))
    folder = building.cache_folders()[-1]
    folder.mkdir(parents=True)
    building.store(folder / building.file_name(), b"bad")
    monkeypatch.setattr(building, "cache_folders", lambda: [folder])  # named by the number of whom it belongs to
    assert building.cached() is not None
    for path in (folder / building.file_name(), folder, tmp_path):
        with monkeypatch.context() as patch:
            lstat = Path.lstat
            patch.setattr(Path, "lstat", lambda p, path=path, lstat=lstat: belongs_to_another(lstat(p), p == path))
            assert building.cached() is None, path


def belongs_to_another(status, is_so):
    return os.stat_result((*status[:4], 12345, *status[5:])) if is_so else status


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="no modes here")
def test_what_others_could_write_or_exchange_is_not_loaded(small, monkeypatch, capfd):
    folder, name = small / "cache", building.file_name()
    folder.mkdir(mode=0o700)
    building.store(folder / name, b"code")
    assert building.cached() == folder / name
    for path in (folder / name, folder, small):
        usual = path.stat().st_mode
        path.chmod(usual | stat.S_IWOTH)
        assert building.cached() is None, path
        path.chmod(usual)
    small.chmod(small.stat().st_mode | stat.S_IWOTH | stat.S_ISVTX)  # as /tmp: nobody can exchange a folder of ours
    assert building.cached() == folder / name
    folder.chmod(0o777 | stat.S_ISVTX)  # nobody can exchange our library, but anybody could put another there
    assert building.cached() == folder / name
    monkeypatch.setattr(building, "cache_folders", lambda: [folder])
    with pytest.raises(EngineUnavailable, match="can be written to"):
        building.build()
    assert f"{folder} is not used: others can write there" in capfd.readouterr().err


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="no modes here")
def test_links_are_not_followed(small):
    name = building.file_name()
    (small / "elsewhere").mkdir(mode=0o700)
    (small / "cache").mkdir(mode=0o700)
    building.store(small / "elsewhere" / name, b"code")
    (small / "cache" / name).symlink_to(small / "elsewhere" / name)
    assert building.cached() is None


def test_half_a_library_is_built_anew(small):
    """A power cut leaves one: to load it would kill the process, at every start."""
    made = building.build()
    whole = made.read_bytes()
    for damaged in (whole[: len(whole) // 2], whole[:-1], b"", whole[:100] + b"x" + whole[101:]):
        made.write_bytes(damaged)
        assert building.cached() is None
    assert building.build() == made
    assert building.cached() == made
    assert made.stat().st_mode & 0o777 == 0o700


def test_one_that_came_with_the_package_is_preferred(monkeypatch, tmp_path):
    """And one for another processor is not taken."""
    monkeypatch.setattr(library, "PACKAGED", tmp_path)
    (tmp_path / "engine-0123456789.so").write_text("for another")
    assert str(tmp_path) not in library.status()
    (tmp_path / building.file_name()).write_bytes(b"")
    assert library.status() == f"built: {tmp_path / building.file_name()}"


# -- portable libraries -----------------------------------------------------------------------------------------------


def test_the_best_portable_library_that_the_processor_can_run_is_taken(small, monkeypatch):
    levels = {"fast": frozenset({"wide", "narrow"}), "slow": frozenset({"narrow"})}
    monkeypatch.setattr(building, "portable_levels", lambda: levels)
    for level in levels:
        (small / building.portable_file_name(level)).write_bytes(b"")
    for features, level in (("narrow wide", "fast"), ("narrow more", "slow"), ("", None)):
        monkeypatch.setattr(building, "_processor", lambda features=features: features)
        expected = None if level is None else small / building.portable_file_name(level)
        assert building.find_portable(small) == expected


def test_a_portable_library_serves_without_a_compiler_only(small, monkeypatch):
    """With a compiler a faster one is built."""
    level = list(building.portable_levels())[-1]
    monkeypatch.setattr(building, "portable_levels", lambda: {level: frozenset()})
    portable = building.build(level)
    assert portable.name == building.portable_file_name(level)
    assert building.cached() is None  # it is not the native one
    monkeypatch.setattr(library, "PACKAGED", portable.parent)
    assert library.status().startswith("will be built at first use")
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CXX", raising=False)
    assert library.status() == f"portable: {portable}"
    loaded = []
    monkeypatch.setattr(library, "_load", lambda file: loaded.append(file) or file.stat())
    library._load_once.__wrapped__()
    assert loaded[-1] == portable
