"""What a fit is given."""

from __future__ import annotations

from collections.abc import Sequence

from ..errors import InvalidInput
from ..recordings import Recording
from ..recordings.consistency import listed, same_cloth, together
from ..recordings.fingerprints import each_once
from ..recordings.size_checks import check_size


def given(recordings: Recording | Sequence[Recording]) -> list[Recording]:
    """The episodes of a fit.

    Raises:
        InvalidInput: none, one twice, different cloths or tables, or something that is no recording.
        RecordingError: one was seen in another unit than metres.
    """
    found = listed(recordings)
    if not found:
        raise InvalidInput("recordings", got="none", expected="at least one episode")
    same_cloth(found)
    each_once(found)
    for recording in found:
        check_size(recording)
    together(found)  # tables that contradict each other are refused now, and not with the result
    return found
