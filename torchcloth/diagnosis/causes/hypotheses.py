"""Catalogue of causes, each one number that changes a world. Amplitude 0 leaves the world as it is.

Typical amplitudes are published magnitudes (KES for friction, flat plates for air, laundering standards for shrinkage).
Hypotheses that a user registers join the search.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from fnmatch import fnmatchcase

from ...episodes.world import RESIDUAL_EFFECT_PREFIX, Hypothesis, WorldModel
from ...errors import InvalidInput
from ...pose.objective import CORRECTION_EFFECT_NAME
from ...recordings import Recording
from . import fabric, grip
from .catalogue import CATALOGUE
from .user_hypothesis_checks import explaining_user_errors

RESERVED_EFFECT_NAMES = frozenset(
    {name for h in CATALOGUE for name in h.effect_names} | {RESIDUAL_EFFECT_PREFIX, CORRECTION_EFFECT_NAME}
)  # patterns: an effect that belongs to one gripper or table has "*" in the place of its name
_registered: list[Hypothesis] = []
_recorders: list[list[Hypothesis]] = []


def register(hypothesis: Hypothesis) -> Hypothesis:
    """Register a hypothesis, which joins every search; one of the same name that was registered before is replaced.

    Raises:
        InvalidInput: a name of the catalogue or of a residual force's law, or invalid fields.
    """
    _check_fields(hypothesis)
    unregister(hypothesis.name)
    taken = "which the catalogue has" if hypothesis.name in {h.name for h in list_known_hypotheses()} else ""
    if hypothesis.name.startswith(f"{RESIDUAL_EFFECT_PREFIX}."):
        taken = "as laws of a residual force are called"
    if taken:
        raise InvalidInput(
            "hypothesis",
            got=f"the name {hypothesis.name!r}, {taken}",
            expected="a name of its own",
            remedy=f"call it e.g. 'my.{hypothesis.name.partition('.')[2]}'",
        )
    for joined in (_registered, *_recorders):
        joined.append(hypothesis)
    return hypothesis


def _check_fields(hypothesis: Hypothesis) -> None:
    for key in ("name", "unit"):
        if not isinstance(text := getattr(hypothesis, key), str) or not text:
            raise InvalidInput(f"{key} of a hypothesis", got=repr(text), expected="a word")
    for key in ("title", "description"):
        if not isinstance(text := getattr(hypothesis, key), str):
            raise InvalidInput(f"{key} of {hypothesis.name!r}", got=repr(text), expected="a sentence")
    for key in ("typical", "smallest_fraction", "step_fraction", "min_amplitude", "max_amplitude"):
        if not isinstance(number := getattr(hypothesis, key), (int, float)):
            raise InvalidInput(f"{key} of {hypothesis.name!r}", got=repr(number), expected="a number")
    names = hypothesis.structurally_equivalent
    if not isinstance(names, tuple | list) or not all(isinstance(name, str) for name in names):
        raise InvalidInput(
            f"structurally_equivalent of {hypothesis.name!r}",
            got=repr(names),
            expected='a tuple of names, ("obs.clock",)',
        )
    if not callable(hypothesis.apply):
        raise InvalidInput(f"apply of {hypothesis.name!r}", got=repr(hypothesis.apply), expected="a function")
    has_wrong_sign = hypothesis.typical == 0 or (hypothesis.typical < 0 and not hypothesis.signed)
    if has_wrong_sign or not math.isfinite(hypothesis.typical):
        expected = "another than 0" if hypothesis.signed else "a value > 0, or signed=True and one below"
        raise InvalidInput(f"typical of {hypothesis.name!r}", got=hypothesis.typical, expected=expected)
    if not 0 < hypothesis.smallest_fraction < math.inf:
        raise InvalidInput(
            f"smallest_fraction of {hypothesis.name!r}",
            got=hypothesis.smallest_fraction,
            expected="a value > 0, e.g. 0.4",
        )
    if not 0 < hypothesis.step_fraction < math.inf:
        raise InvalidInput(
            f"step_fraction of {hypothesis.name!r}", got=hypothesis.step_fraction, expected="a value > 0, e.g. 0.1"
        )
    ends = hypothesis.min_amplitude, hypothesis.max_amplitude
    if not ends[0] <= min(0.0, hypothesis.typical) <= max(0.0, hypothesis.typical) <= ends[1]:
        expected = f"ends about 0 and the typical {hypothesis.typical:g}"
        raise InvalidInput(
            f"min_amplitude and max_amplitude of {hypothesis.name!r}",
            got=f"{ends[0]:g} and {ends[1]:g}",
            expected=expected,
        )


def unregister(name: str) -> None:
    """Remove a registered hypothesis."""
    _registered[:] = [h for h in _registered if h.name != name]


@contextmanager
def record_registrations() -> Iterator[list[Hypothesis]]:
    """Yield a list of the hypotheses that are registered inside the block."""
    _recorders.append([])
    try:
        yield _recorders[-1]
    finally:
        _recorders.pop()


def list_known_hypotheses() -> list[Hypothesis]:
    """Return all hypotheses of the catalogue, then those that users registered."""
    return [*CATALOGUE, *_registered]


def list_hypotheses(model: WorldModel, recordings: Sequence[Recording]) -> list[Hypothesis]:
    """Return the hypotheses that recordings can inform about.

    Args:
        model: the base model; hypotheses that it has accepted are left out.
        recordings: the episodes.
    """
    excluded = () if "bending" in model.base.cloth.effects else fabric.BENDING_EFFECTS
    asked = [h for h in model.not_accepted(list_known_hypotheses()) if h.effect not in excluded]
    for hypothesis in _registered:
        with explaining_user_errors(hypothesis):
            _check_effect_names(hypothesis, model)
            any(hypothesis.is_applicable(r) for r in recordings)
    return [adapt_hypothesis(h, model, recordings) for h in asked if any(h.is_applicable(r) for r in recordings)]


def _check_effect_names(hypothesis: Hypothesis, model: WorldModel) -> None:
    """Raise InvalidInput for a name of the catalogue: the later effect would silently replace the earlier one."""
    for name, effect in hypothesis.apply_to(model.base, hypothesis.typical).cloth.effects.items():
        is_reserved = any(fnmatchcase(name, pattern) for pattern in RESERVED_EFFECT_NAMES)
        if is_reserved and not type(effect).__module__.startswith("torchcloth."):
            got = f"an effect {type(effect).__name__} named {name!r}, as the catalogue calls one of its own"
            raise InvalidInput(f"hypothesis {hypothesis.name!r}", got=got, expected="another name")


def adapt_hypothesis(hypothesis: Hypothesis, model: WorldModel, recordings: Sequence[Recording] = ()) -> Hypothesis:
    """Adapt a hypothesis to recordings: friction stays positive, and a table determines the height of a camera.

    Args:
        hypothesis: of the catalogue.
        model: the base model.
        recordings: the episodes.
    """
    if hypothesis.name == "contact.mu":
        return replace(hypothesis, min_amplitude=grip.compute_min_friction_change(model.base.cloth))
    if hypothesis.name == "obs.extrinsic[z]" and any(r.colliders for r in recordings):
        return replace(hypothesis, structurally_equivalent=())
    return hypothesis


def select_user_hypotheses(asked: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return the hypotheses that are not in the catalogue, registered or not.

    Raises:
        InvalidInput: two of one name, or one with invalid fields.
    """
    names = [h.name for h in asked]
    if duplicates := sorted({name for name in names if names.count(name) > 1}):
        raise InvalidInput("hypotheses", got=f"{duplicates[0]!r} twice", expected="each once")
    in_catalogue = {h.name for h in list_known_hypotheses()} - {h.name for h in _registered}
    user_hypotheses = [h for h in asked if h.name not in in_catalogue]
    for hypothesis in user_hypotheses:
        _check_fields(hypothesis)
    return user_hypotheses
