"""Every importer reads what the format's own library wrote: import, write, read, and the numbers are the same."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import foreign_formats

from torchcloth import recordings as rec
from torchcloth.recordings import formats

LOSSY = {"lerobot": 4}  # grey levels of 255: AV1, measured 1


def streams_of(recording: rec.Recording) -> dict[str, rec.ImageStream]:
    kinds = ("depth", "color", "mask")
    result = {f"{name}/{kind}": getattr(c, kind) for name, c in recording.cameras.items() for kind in kinds}
    return {key: stream for key, stream in result.items() if stream is not None}


def arrays_of(recording: rec.Recording) -> dict[str, np.ndarray]:
    motions = [*recording.grippers.items(), *recording.joints.items()]
    result = {f"{name}/{key}": value for name, m in motions for key, value in vars(m).items()}
    if recording.points is not None:
        result |= {"points/t": recording.points.t, "points/xyz": recording.points.xyz}
    return {key: value for key, value in result.items() if isinstance(value, np.ndarray)}


def check(
    recording: rec.Recording, truth: foreign_formats.ForeignRecording, *, lossy: int = 0, points: float = 0.0
) -> None:
    result = streams_of(recording)
    assert result.keys() == truth.images.keys()
    for key, stream in result.items():
        np.testing.assert_allclose(stream.t, truth.times[key], rtol=0, atol=1e-9, err_msg=key)
        assert len(stream) == len(truth.images[key])
        for i, expected in enumerate(truth.images[key]):
            pixels = stream.load(i)
            assert pixels.dtype == expected.dtype
            assert np.abs(pixels.astype(int) - expected.astype(int)).max() <= lossy, (key, i)
    result = arrays_of(recording)
    assert result.keys() == truth.arrays.keys()
    for key, expected in truth.arrays.items():
        np.testing.assert_allclose(
            result[key], expected, rtol=0, atol=points if key == "points/xyz" else 0, err_msg=key
        )


@pytest.mark.parametrize("name", foreign_formats.WRITERS)
def test_import_write_read(name, tmp_path):
    """As an episode, and from there as MCAP."""
    truth = foreign_formats.WRITERS[name](tmp_path)
    imported = formats.read(truth.path, scene=truth.write_scene(), **truth.options)
    check(imported, truth, lossy=LOSSY.get(name, 0))
    counted = []
    back = rec.read(rec.write(imported, tmp_path / "ep", on_image=lambda: counted.append(1), compact=False))
    check(back, truth, lossy=LOSSY.get(name, 0), points=1e-7)  # float32 in the episode
    assert len(counted) == sum(map(len, truth.images.values()))
    assert back.extra["source"]["format"] == name
    assert formats.detect_format(truth.path) == name
    again = formats.read(formats.write_mcap(back, tmp_path / "ep.mcap"))
    check(again, truth, lossy=LOSSY.get(name, 0), points=1e-7)
