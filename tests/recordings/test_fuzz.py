"""Damage of any kind either leaves a valid episode or is refused by name; nothing else may come out."""

from __future__ import annotations

import copy
import json
import random
import warnings

import numpy as np
import pytest

from torchcloth import recordings as rec
from torchcloth.errors import TorchclothError
from torchcloth.recordings.files import save_npz

MUTATIONS = 300
FILES = ["episode.json", "motion.npz", "points.npz", "markers.npz", "cloth.obj", "cam0/timestamps.csv"]
VALUES = [
    None,
    True,
    0,
    -1,
    1e400,
    -1e308,
    10**400,
    "",
    "x",
    "\ud800",
    "\0",
    "/",
    [],
    {},
    [[]],
    [None],
    [["a"]],
    [[1, 2], 3],
    {"": {}},
]


def survives(episode) -> bool:
    """Read the episode; True when it was accepted."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            back = rec.read(episode)
    except TorchclothError as error:
        assert "\n" not in str(error)  # noqa: PT017
        return False
    for motion in (*back.grippers.values(), *back.joints.values()):
        assert np.isfinite(motion.t).all()
        assert (np.diff(motion.t) > 0).all()
    for motion in back.grippers.values():
        assert np.isfinite(motion.position).all()
        assert np.linalg.norm(motion.quat_wxyz, axis=-1) == pytest.approx(1.0, abs=1e-3)
    for joints in back.joints.values():
        assert np.isfinite(joints.q).all()
    if back.points is not None:
        assert np.isfinite(back.points.xyz).all()
        assert sum(map(len, map(back.points.frame, range(len(back.points))))) == len(back.points.xyz)
    if back.markers is not None:
        seen = np.isfinite(back.markers.xyz)
        assert (seen.any(-1) == seen.all(-1)).all()
    return True


@pytest.mark.parametrize("file", FILES)
def test_damaged_bytes(episode, file):
    assert survives(episode)
    rng, whole = random.Random(file), (episode / file).read_bytes()
    accepted = 0
    for _ in range(MUTATIONS):
        data = bytearray(whole)
        for _ in range(rng.choice([1, 1, 1, 5, 50])):
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        if rng.random() < 0.2:
            data = data[: rng.randrange(len(data))]
        if rng.random() < 0.1:
            i, j = sorted(rng.sample(range(len(whole)), 2))
            data[i:j] = data[i:j] * 2
        (episode / file).write_bytes(data)
        accepted += survives(episode)
    assert accepted < MUTATIONS  # the damage was noticed


def places(node, path=()):
    """Every key path of a JSON tree."""
    for key in node.keys() if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ():
        yield (*path, key)
        yield from places(node[key], (*path, key))


def test_damaged_json_values(episode):
    assert survives(episode)
    rng, path = random.Random(0), episode / "episode.json"
    whole = json.loads(path.read_text())
    paths, accepted = list(places(whole)), 0
    for _ in range(2 * MUTATIONS):
        tree = copy.deepcopy(whole)
        *outer, last = rng.choice(paths)
        node = tree
        for key in outer:
            node = node[key]
        kind = rng.randrange(3)
        if kind == 0:
            del node[last]
        elif kind == 1:
            node[last] = rng.choice(VALUES)
        else:  # a value from elsewhere in the file
            donor = whole
            for key in rng.choice(paths):
                donor = donor[key]
            node[last] = copy.deepcopy(donor)
        path.write_text(json.dumps(tree))
        accepted += survives(episode)
    assert 0 < accepted < 2 * MUTATIONS


def damage(rng: random.Random, array: np.ndarray) -> np.ndarray:
    """One plausible fault of a recorder."""
    array = array.copy()
    kind = rng.randrange(8)
    if kind == 0 and array.size and array.dtype.kind == "f":
        array.flat[rng.randrange(array.size)] = rng.choice([np.nan, np.inf, -np.inf, 1e300, -1e300, 0.0])
    elif kind == 1 and array.size and array.dtype.kind in "iu":
        array.flat[rng.randrange(array.size)] = rng.choice(
            [0, -1, np.iinfo(array.dtype).max, np.iinfo(array.dtype).min]
        )
    elif kind == 2:
        array = array[..., None]
    elif kind == 3 and array.ndim:
        array = array[: rng.randrange(len(array) + 1)]
    elif kind == 4 and array.ndim:
        array = array[::-1]
    elif kind == 5:
        dtypes = ["f2", "f4", ">f8", "i1", "i8", "u8", "?", "c16", "S4", "U4", "m8[s]", "M8[s]"]
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            array = array.astype(rng.choice(dtypes))
    elif kind == 6:
        array = np.zeros(array.shape, dtype=[("a", "f8"), ("b", "i4")])
    else:
        array = array * 1000 if array.dtype.kind == "f" else array.reshape(-1)
    return array


@pytest.mark.parametrize("file", ["motion.npz", "points.npz", "markers.npz"])
def test_damaged_arrays(episode, file):
    assert survives(episode)
    rng = random.Random(file)
    with np.load(episode / file) as stored:
        whole, accepted = dict(stored), 0
    for _ in range(MUTATIONS):
        arrays, key, other = dict(whole), *rng.choices(list(whole), k=2)
        kind = rng.randrange(6)
        if kind == 0:
            del arrays[key]
        elif kind == 1:
            arrays[key], arrays[other] = arrays[other], arrays[key]
        elif kind == 2:
            arrays[rng.choice(["", "x", "x/", "/t", "left/", "left/ö", "a/b/c", "."])] = arrays.pop(key)
        else:
            arrays[key] = damage(rng, arrays[key])
        save_npz(episode / file, arrays)
        accepted += survives(episode)
    assert accepted < MUTATIONS
