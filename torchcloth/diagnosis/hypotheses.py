"""The known causes, each as one number that changes a world. Amplitude 0 is the world as it is.

Typical amplitudes are published magnitudes (KES for friction, flat plates for air, laundering standards for shrinkage).
What a user registers joins the search.
"""

from __future__ import annotations

from collections.abc import Sequence

from ..errors import InvalidInput
from ..recordings import Recording
from . import air, fabric, grip, observer
from .world import Hypothesis, Model

_registered: list[Hypothesis] = []


def register(hypothesis: Hypothesis) -> Hypothesis:
    """Let a hypothesis of one's own join every search; one of the same name that was registered before is replaced.

    Raises:
        InvalidInput: a name of the catalogue, or a typical amplitude that it cannot have.
    """
    if hypothesis.typical == 0 or (hypothesis.typical < 0 and not hypothesis.signed):
        expected = "another than 0" if hypothesis.signed else "a value > 0, or signed=True"
        raise InvalidInput(f"typical of {hypothesis.name!r}", got=hypothesis.typical, expected=expected)
    forget(hypothesis.name)
    if hypothesis.name in {h.name for h in known()}:
        raise InvalidInput(
            "hypothesis",
            got=f"the name {hypothesis.name!r}, which the catalogue has",
            expected="a name of its own",
            remedy=f"call it e.g. 'my.{hypothesis.name.partition('.')[2]}'",
        )
    _registered.append(hypothesis)
    return hypothesis


def forget(name: str) -> None:
    """Take a registered hypothesis out again."""
    _registered[:] = [h for h in _registered if h.name != name]


def known() -> list[Hypothesis]:
    """All hypotheses, the user's last."""
    return [*air.HYPOTHESES, *fabric.HYPOTHESES, *grip.HYPOTHESES, *observer.HYPOTHESES, *_registered]


def catalogue(model: Model, recordings: Sequence[Recording]) -> list[Hypothesis]:
    """All hypotheses that the recordings could say something about."""
    without = () if "bending" in model.base.cloth.effects else fabric.OF_BENDING
    asked = [h for h in model.others(known()) if h.effect not in without]
    return [h for h in asked if any(h.needs(r) for r in recordings)]


def registered() -> list[Hypothesis]:
    """The user's own."""
    return list(_registered)
