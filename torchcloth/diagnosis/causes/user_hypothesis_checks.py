"""Checks of a user's hypotheses before anything long is simulated."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from ...episodes.observed import Episode
from ...episodes.user_errors import EXPECTED_APPLY, explain_user_error
from ...episodes.world import Hypothesis, World
from ...errors import InvalidInput, TorchclothError

NEGLIGIBLE_FRACTION = 1e-6  # of the typical amplitude
MAX_NEGLIGIBLE_RESPONSE = 0.1  # response to a negligible amplitude, as a fraction of the typical one
NO_RESPONSE_M = 1e-9


def check_user_hypotheses(hypotheses: Sequence[Hypothesis], base: World, episodes: Sequence[Episode]) -> None:
    """Simulate the first frames of every episode with each hypothesis, and of one episode with hardly any of it.

    Args:
        hypotheses: those of a user.
        base: the base model's world.
        episodes: the episodes.

    Raises:
        InvalidInput: a hypothesis that raises an error, returns no world, or changes the world at amplitude 0.
    """
    if not hypotheses:
        return
    early = episodes[0].first_fraction(0.0)
    plain = base.simulate_observed(early).x
    for hypothesis in hypotheses:
        with explaining_user_errors(hypothesis):
            responses = []
            for amplitude in (NEGLIGIBLE_FRACTION * hypothesis.typical, hypothesis.typical):
                world = hypothesis.apply_to(base, amplitude)
                responses.append(float((world.simulate_observed(early).x - plain).square().mean().sqrt()))
            for k, episode in enumerate(episodes):
                world.apply_motion(episode)
                if k:
                    world.simulate_observed(episode.first_fraction(0.0))
            if not all(map(math.isfinite, responses)):
                raise InvalidInput(
                    f"hypothesis {hypothesis.name!r}",
                    got="frames that are not finite",
                    expected=EXPECTED_APPLY,
                )
            if responses[0] > MAX_NEGLIGIBLE_RESPONSE * responses[1] + NO_RESPONSE_M:
                raise InvalidInput(
                    f"hypothesis {hypothesis.name!r}",
                    got=f"{1e3 * responses[0]:.2g} mm from a negligible amplitude, {1e3 * responses[1]:.2g} mm from a "
                    "typical one",
                    expected="amplitude 0 to be the world as it is",
                    remedy="for a factor, take its difference from 1",
                )
        with explaining_user_errors(hypothesis):  # a world that cannot have the opposite amplitude is accepted
            if hypothesis.is_reversible:
                hypothesis.apply_to(base, hypothesis.opposite.typical).simulate_observed(early)


@contextmanager
def explaining_user_errors(hypothesis: Hypothesis) -> Iterator[None]:
    """Explain errors inside the block by their place in the user's file; the library's own errors are dropped.

    Raises:
        InvalidInput: an error of the user's code.
    """
    try:
        yield
    except InvalidInput as error:
        if f"hypothesis {hypothesis.name!r}" in str(error):
            raise
    except TorchclothError:
        pass  # the search reports that the hypothesis cannot be simulated
    except Exception as error:
        raise explain_user_error(hypothesis.name, error) from error
