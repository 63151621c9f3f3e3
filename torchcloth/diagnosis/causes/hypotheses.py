"""The known causes, each as one number that changes a world. Amplitude 0 is the world as it is.

Typical amplitudes are published magnitudes (KES for friction, flat plates for air, laundering standards for shrinkage).
What a user registers joins the search.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

from ...episodes.world import RESIDUAL, Hypothesis, Model
from ...errors import InvalidInput
from ...pose.objective import CORRECTION
from ...recordings import Recording
from . import air, fabric, grip, observer
from .user_hypothesis_checks import blamed

TAKEN = frozenset(
    {air.DRAG, "linear", "added_mass", "viscosity", "hem", "seam", "rest_shape", "gravity", "bending"}
    | {"bending_friction", "shear_friction", RESIDUAL, CORRECTION}
)
BEGIN, END = "slip_", "_pull"  # of names with a gripper's or a table's
_registered: list[Hypothesis] = []
_notes: list[list[Hypothesis]] = []


def register(hypothesis: Hypothesis) -> Hypothesis:
    """Let a hypothesis of one's own join every search; one of the same name that was registered before is replaced.

    Raises:
        InvalidInput: a name of the catalogue or of a residual force's law, or a typical amplitude or share that it
            cannot have.
    """
    _check_size(hypothesis)
    forget(hypothesis.name)
    taken = "which the catalogue has" if hypothesis.name in {h.name for h in known()} else ""
    if hypothesis.name.startswith(f"{RESIDUAL}."):
        taken = "as laws of a residual force are called"
    if taken:
        raise InvalidInput(
            "hypothesis",
            got=f"the name {hypothesis.name!r}, {taken}",
            expected="a name of its own",
            remedy=f"call it e.g. 'my.{hypothesis.name.partition('.')[2]}'",
        )
    for joined in (_registered, *_notes):
        joined.append(hypothesis)
    return hypothesis


def _check_size(hypothesis: Hypothesis) -> None:
    for key in ("name", "unit"):
        if not isinstance(said := getattr(hypothesis, key), str) or not said:
            raise InvalidInput(f"{key} of a hypothesis", got=repr(said), expected="a word")
    if not isinstance(hypothesis.description, str):
        raise InvalidInput(f"says of {hypothesis.name!r}", got=repr(hypothesis.description), expected="a sentence")
    for key in ("typical", "share", "step", "low", "high"):
        if not isinstance(number := getattr(hypothesis, key), (int, float)):
            raise InvalidInput(f"{key} of {hypothesis.name!r}", got=repr(number), expected="a number")
    if not isinstance(kin := hypothesis.structurally_equivalent, tuple | list) or not all(isinstance(name, str) for name in kin):
        raise InvalidInput(f"kin of {hypothesis.name!r}", got=repr(kin), expected='a tuple of names, ("obs.clock",)')
    if not callable(hypothesis.apply):
        raise InvalidInput(f"apply of {hypothesis.name!r}", got=repr(hypothesis.apply), expected="a function")
    wrong = hypothesis.typical == 0 or (hypothesis.typical < 0 and not hypothesis.signed)
    if wrong or not math.isfinite(hypothesis.typical):
        expected = "another than 0" if hypothesis.signed else "a value > 0, or signed=True and one below"
        raise InvalidInput(f"typical of {hypothesis.name!r}", got=hypothesis.typical, expected=expected)
    if not 0 < hypothesis.smallest_fraction < math.inf:
        raise InvalidInput(f"share of {hypothesis.name!r}", got=hypothesis.smallest_fraction, expected="a value > 0, e.g. 0.4")
    if not 0 < hypothesis.step < math.inf:
        raise InvalidInput(f"step of {hypothesis.name!r}", got=hypothesis.step, expected="a value > 0, e.g. 0.1")
    ends = hypothesis.low, hypothesis.high
    if not ends[0] <= min(0.0, hypothesis.typical) <= max(0.0, hypothesis.typical) <= ends[1]:
        expected = f"ends about 0 and the typical {hypothesis.typical:g}"
        raise InvalidInput(
            f"low and high of {hypothesis.name!r}", got=f"{ends[0]:g} and {ends[1]:g}", expected=expected
        )


def forget(name: str) -> None:
    """Take a registered hypothesis out again."""
    _registered[:] = [h for h in _registered if h.name != name]


@contextmanager
def noted() -> Iterator[list[Hypothesis]]:
    """What is registered meanwhile, anew or again."""
    _notes.append([])
    try:
        yield _notes[-1]
    finally:
        _notes.pop()


def known() -> list[Hypothesis]:
    """All hypotheses, the user's last."""
    return [*air.HYPOTHESES, *fabric.HYPOTHESES, *grip.HYPOTHESES, *observer.HYPOTHESES, *_registered]


def catalogue(model: Model, recordings: Sequence[Recording]) -> list[Hypothesis]:
    """All hypotheses that the recordings could say something about."""
    without = () if "bending" in model.base.cloth.effects else fabric.OF_BENDING
    asked = [h for h in model.others(known()) if h.effect not in without]
    for own in _registered:
        with blamed(own):
            _refuse_taken(own, model)
            any(own.needs(r) for r in recordings)
    return [here(h, model, recordings) for h in asked if any(h.needs(r) for r in recordings)]


def _refuse_taken(own: Hypothesis, model: Model) -> None:
    """Of two effects of one name the later would silently take the place of the earlier."""
    for name, effect in own.applied(model.base, own.typical).cloth.effects.items():
        taken = name in TAKEN or name.startswith(BEGIN) or name.endswith(END)
        if taken and not type(effect).__module__.startswith("torchcloth."):
            got = f"an effect {type(effect).__name__} named {name!r}, as the catalogue calls one of its own"
            raise InvalidInput(f"hypothesis {own.name!r}", got=got, expected="another name")


def here(hypothesis: Hypothesis, model: Model, recordings: Sequence[Recording] = ()) -> Hypothesis:
    """As these recordings have it: friction stays above none, and a table tells how high a camera stands."""
    if hypothesis.name == "contact.mu":
        return replace(hypothesis, low=grip.least_change(model.base.cloth))
    if hypothesis.name == "obs.extrinsic[z]" and any(r.colliders for r in recordings):
        return replace(hypothesis, kin=())
    return hypothesis


def own_among(asked: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Those that the catalogue does not have, registered or not.

    Raises:
        InvalidInput: two of one name, or one that ``register`` would refuse for its numbers.
    """
    names = [h.name for h in asked]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise InvalidInput("hypotheses", got=f"{twice[0]!r} twice", expected="each once")
    theirs = {h.name for h in known()} - {h.name for h in _registered}
    own = [h for h in asked if h.name not in theirs]
    for hypothesis in own:
        _check_size(hypothesis)
    return own
