"""Causes of a user's own, tried before anything long is simulated."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from ...episodes.observed import Episode
from ...episodes.user_errors import GIVES, blame
from ...episodes.world import Hypothesis, World
from ...errors import InvalidInput, TorchclothError

NEAR = 1e-6  # of the typical amplitude: as good as none
CONTINUOUS = 0.1  # of what the typical amplitude does, that such an amplitude may do
NOTHING = 1e-9  # m


def check_own(own: Sequence[Hypothesis], base: World, episodes: Sequence[Episode]) -> None:
    """Simulate the first frames of every episode with each of them, and those of one with next to nothing of it.

    Raises:
        InvalidInput: one fails in an error of its own, gives no world, or does not end where the world is as it is.
    """
    if not own:
        return
    early = episodes[0].first_fraction(0.0)
    plain = base.frames(early).x
    for hypothesis in own:
        with blamed(hypothesis):
            moved = []
            for amplitude in (NEAR * hypothesis.typical, hypothesis.typical):
                world = hypothesis.applied(base, amplitude)
                moved.append(float((world.frames(early).x - plain).square().mean().sqrt()))
            for k, episode in enumerate(episodes):
                world.driven(episode)
                if k:
                    world.frames(episode.first_fraction(0.0))
            if not all(map(math.isfinite, moved)):
                raise InvalidInput(
                    f"hypothesis {hypothesis.name!r}",
                    got="frames that are no numbers",
                    expected=GIVES,
                )
            if moved[0] > CONTINUOUS * moved[1] + NOTHING:
                raise InvalidInput(
                    f"hypothesis {hypothesis.name!r}",
                    got=f"{1e3 * moved[0]:.2g} mm from next to nothing of it, {1e3 * moved[1]:.2g} mm from a usual one",
                    expected="amplitude 0 to be the world as it is",
                    remedy="of a factor, take what it differs from 1 by",
                )
        with blamed(hypothesis):  # on its own: a world that cannot have the other way passes
            if hypothesis.reverses:
                hypothesis.applied(base, hypothesis.opposite.typical).frames(early)


@contextmanager
def blamed(hypothesis: Hypothesis) -> Iterator[None]:
    """Errors that are none of the library's are said by the place in the user's file; what a world cannot be passes.

    Raises:
        InvalidInput: for them.
    """
    try:
        yield
    except InvalidInput as error:
        if f"hypothesis {hypothesis.name!r}" in str(error):
            raise
    except TorchclothError:
        pass  # the search says so
    except Exception as error:
        raise blame(hypothesis.name, error) from error
