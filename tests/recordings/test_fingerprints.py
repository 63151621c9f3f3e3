"""An episode is recognised by what it holds, whatever it is called; its repetition is another one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from torchcloth.errors import InvalidInput
from torchcloth.recordings.fingerprints import fingerprint, reject_duplicates, same_episode


def noisy(recording, noise):
    return replace(recording, points=replace(recording.points, xyz=recording.points.xyz + noise))


def test_one_episode_twice_is_refused_under_any_name(recording, tmp_path):
    copy = replace(recording, path=tmp_path / "copy", clock_offset=0.0)
    with pytest.raises(InvalidInput, match="'recording' and 'copy', which hold the same; expected each once"):
        reject_duplicates([recording, noisy(recording, 0.01), copy])
    with pytest.raises(InvalidInput, match="episodes; got 'copy' twice; expected each once; leave one out"):
        reject_duplicates([copy, copy])


def test_noise_of_its_own_makes_a_repetition_even_where_its_mean_is_nothing(recording):
    noise = np.random.default_rng(1).normal(0, 1e-3, recording.points.xyz.shape)
    other = noisy(recording, noise - noise.mean(0))
    assert same_episode(fingerprint(recording), fingerprint(other))
    reject_duplicates([recording, other])


def test_forces_are_told_apart_where_nothing_was_seen(recording):
    felt = replace(recording, points=None, markers=None)
    with pytest.raises(InvalidInput, match="twice"):
        reject_duplicates([felt, felt])
    blind = replace(felt, grippers={}, joints={})
    reject_duplicates([blind, blind])  # that there is nothing is said elsewhere
