"""Tension tables: round trip, and one clear error for whatever cannot be trusted."""

import json
from dataclasses import replace

import numpy as np
import pytest

from torchcloth import recordings as rec
from torchcloth.errors import RecordingError


@pytest.fixture
def table() -> rec.ForceDisplacement:
    return rec.ForceDisplacement(
        length=0.1,
        width=0.05,
        angle=np.pi / 4,
        displacement=np.array([0.0, 1e-3, 0.0, 1.1e-3]),
        force=np.array([0.1, 1 / 3, 0.1, 0.4]),
        lateral_strain=np.array([0.0, -0.002, np.nan, -0.003]),
        repeat=np.array([1, 1, 2, 2]),
        preload=0.1,
        licence="CC0",
        extra={"machine": "an old one"},
    )


@pytest.fixture
def folder(table, tmp_path):
    return rec.write_tension(table, tmp_path / "table")


def test_round_trip_is_exact(table, folder):
    back = rec.read_tension(folder)
    for key in ("length", "width", "angle", "preload", "provenance", "licence", "extra"):
        assert getattr(back, key) == getattr(table, key)
    for key in ("displacement", "force", "lateral_strain", "repeat"):
        assert np.array_equal(getattr(back, key), getattr(table, key), equal_nan=key == "lateral_strain")
    assert back.path == folder
    assert (folder / "table.csv").read_text().splitlines()[0] == "repeat,displacement,force,lateral_strain"


def test_what_is_absent_stays_absent(table, tmp_path):
    bare = replace(table, lateral_strain=None, repeat=None, licence=None, extra={})
    back = rec.read_tension(rec.write_tension(bare, tmp_path / "bare"))
    assert back.lateral_strain is None
    assert back.repeat is None
    assert back.licence is None


def test_repeats(table):
    second = table.select_repeats(2)
    assert second.force.tolist() == [0.1, 0.4]
    assert second.preload == table.preload
    assert second.extra == table.extra
    assert second.strain == pytest.approx([0.0, 0.011])


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("length", 97.0, "looks like millimetres"),
        ("width", 0.0, "too small"),
        ("angle", 45.0, "looks like degrees"),
        ("preload", -1.0, "too small"),
        ("format", "torchcloth-recording", "is another format"),
        ("version", 2, "is another format"),
        ("provenance", None, "provenance is missing"),
        ("length", True, "not a finite number"),
    ],
)
def test_a_wrong_specimen_is_refused(folder, key, value, message):
    meta = json.loads((folder / "table.json").read_text())
    (folder / "table.json").write_text(json.dumps({**meta, key: value}))
    with pytest.raises(RecordingError, match=message) as caught:
        rec.read_tension(folder)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "has other columns"),
        ("displacement,load\n0,1\n1,2\n", "has other columns"),
        ("displacement,force,force\n0,1,1\n1,2,2\n", "has other columns"),
        ("displacement,force\n0,1\n", "too short"),
        ("displacement,force\n0,1\n0.001\n", "line 3; got 1 cells"),
        ("displacement,force\n0,1\n0.001,\n", "force is not numbers"),
        ("displacement,force\n0,1\n0.001,nan\n", "force is not finite"),
        ("displacement,force\n0,1\n0.001,inf\n", "force is not finite"),
        ("displacement,force\n0,1\n1.9,2\n", "looks like millimetres"),
        ("displacement,force\n0,0\n0.001,0\n", "0 in every row; .*load cell"),
        ("repeat,displacement,force\n0,0,1\n0.5,0,1\n", "repeat is not whole"),
        ('displacement,force\n0,"1\n', "is not CSV|cells"),
    ],
)
def test_wrong_rows_are_refused(folder, text, message):
    (folder / "table.csv").write_text(text)
    with pytest.raises(RecordingError, match=message) as caught:
        rec.read_tension(folder)
    assert "\n" not in str(caught.value)


def test_missing_files_are_named(folder, tmp_path):
    with pytest.raises(RecordingError, match=r"table\.json is missing"):
        rec.read_tension(tmp_path)
    (folder / "table.csv").unlink()
    with pytest.raises(RecordingError, match=r"table\.csv is missing"):
        rec.read_tension(folder)


def test_a_refused_write_leaves_nothing(table, tmp_path):
    with pytest.raises(RecordingError, match="looks like millimetres"):
        rec.write_tension(replace(table, length=100.0), tmp_path / "bad")
    assert list(tmp_path.iterdir()) == []


def test_damaged_bytes_are_refused_or_harmless(folder):
    """Damage: an error, or a table whose rows all still are numbers in SI units."""
    draw, whole = np.random.default_rng(0), (folder / "table.csv").read_bytes()
    accepted = 0
    for _ in range(100):
        damaged = bytearray(whole)
        damaged[draw.integers(len(damaged))] = draw.integers(256)
        (folder / "table.csv").write_bytes(damaged)
        try:
            back = rec.read_tension(folder)
        except RecordingError:
            continue
        assert np.isfinite(back.force).all()
        assert np.abs(back.strain).max() <= 5
        accepted += 1
    assert 0 < accepted < 100


def test_a_table_with_a_byte_order_mark_is_read(tmp_path):
    specimen = {"length": 0.1, "width": 0.05, "angle": 0.0}
    table = rec.ForceDisplacement(**specimen, displacement=np.arange(3) * 1e-3, force=np.arange(3.0))
    folder = rec.write_tension(table, tmp_path / "table")
    for path in folder.iterdir():
        path.write_text(path.read_text(encoding="utf-8"), encoding="utf-8-sig")
    np.testing.assert_array_equal(rec.read_tension(folder).force, table.force)
