"""Catalogue of causes: everything that a diagnosis asks about, before a user registers more.

A cause that an effect declares in its ``amplitudes`` is here by itself. ``air``, ``fabric`` and ``grip`` say how it
changes a world where that is more than one new effect in the cloth.
"""

from __future__ import annotations

from collections.abc import Iterable

from ... import effects
from ...effects import AbstractEffect
from ...episodes.world import Hypothesis
from . import air, fabric, grip, observer


def list_undeclared_causes(classes: Iterable[type[AbstractEffect]], listed: Iterable[Hypothesis]) -> list[Hypothesis]:
    """Build the hypotheses that effects declare and that a list does not have yet.

    Args:
        classes: of effects.
        listed: hypotheses that are there already.
    """
    names = {h.effect for h in listed}
    added: dict[str, Hypothesis] = {}
    for effect in classes:
        for parameter, amplitude in effect.amplitudes.items():
            if amplitude.cause and amplitude.cause not in names and amplitude.cause not in added:
                added[amplitude.cause] = Hypothesis.from_amplitude(effect, parameter)
    return list(added.values())


def list_effect_classes() -> list[type[AbstractEffect]]:
    """Return the classes of all effects that the library exports, except the abstract one."""
    exported = [getattr(effects, name) for name in effects.__all__]
    return [e for e in exported if issubclass(e, AbstractEffect) and e is not AbstractEffect]


_LISTED = (*air.HYPOTHESES, *fabric.HYPOTHESES, *grip.HYPOTHESES, *observer.HYPOTHESES)
CATALOGUE = (*_LISTED, *list_undeclared_causes(list_effect_classes(), _LISTED))
