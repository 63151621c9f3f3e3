"""Faults in a user's causes are reported before any long simulation."""

import math
from dataclasses import replace

import pytest
from helpers import sheet_episodes

from torchcloth import effects
from torchcloth.diagnosis.causes.hypotheses import (
    Hypothesis,
    list_hypotheses,
    register,
    select_user_hypotheses,
    unregister,
)
from torchcloth.diagnosis.causes.user_hypothesis_checks import check_user_hypotheses
from torchcloth.diagnosis.data.dataset import prepare_data
from torchcloth.diagnosis.models.base_model import build_base_model
from torchcloth.errors import InvalidInput


def fails(*_):
    return 1 / 0


WRONG = {
    "nothing": (lambda w, a: None, "TypeError: apply gives NoneType, no World"),
    "divides": (fails, "ZeroDivisionError: division by zero in .*test_user_hypothesis_checks.py, line"),
    "a motion": (
        lambda w, a: w.with_motion_transform(fails),
        "ZeroDivisionError: .*test_user_hypothesis_checks.py, line",
    ),
    "a view": (
        lambda w, a: w.with_observation_transform(fails),
        "ZeroDivisionError: .*test_user_hypothesis_checks.py, line",
    ),
    "a view of one episode": (
        lambda w, a: w.with_observation_transform(
            lambda frames, e: fails() if float(e.motion["left"].pose[3, 1, 3]) > 0.005 else frames
        ),
        "ZeroDivisionError: .*test_user_hypothesis_checks.py, line",
    ),
    "no numbers": (
        lambda w, a: w.with_observation_transform(lambda frames, e: frames._replace(x=frames.x * math.nan)),
        "frames that are not finite",
    ),
    "a factor": (
        lambda w, a: w.with_cloth({"my": effects.MassDamping(5 * (1 + a))}),
        "from a negligible amplitude.*amplitude 0 to be the world as it is",
    ),
}


@pytest.fixture
def world():
    recordings = [sheet_episodes.make_episode(motion) for motion in ("slow", "fast")]
    model = build_base_model(recordings[0])
    return recordings, model, prepare_data(model, recordings)


@pytest.mark.parametrize("case", WRONG)
def test_a_cause_of_ones_own_is_tried(world, case):
    _, model, setting = world
    apply, said = WRONG[case]
    own = Hypothesis("my.own", "-", 1.0, apply)
    with pytest.raises(InvalidInput, match=f"hypothesis 'my.own'; got .*{said}"):
        check_user_hypotheses([own], model.base, setting.episodes)


def test_what_fails_at_some_amplitudes_only_is_no_world_there(world):
    """The first frames with a typical amplitude are fine; a search may come to others."""
    _, model, _ = world
    own = Hypothesis("my.root", "-", 1.0, lambda w, a: w if math.sqrt(a) < 2 else None, signed=True)  # type: ignore[arg-type]
    assert isinstance(own.apply_to(model.base, 1.0), type(model.base))
    for amplitude, said in ((-1.0, "ValueError"), (9.0, "no World")):
        with pytest.raises(InvalidInput, match=f"hypothesis 'my.root'; got .*{said}"):
            model.with_hypothesis(own, amplitude).build_world()


def test_what_is_given_and_not_registered_is_ones_own_as_well(world):
    recordings, model, _ = world
    known, own = list_hypotheses(model, recordings), Hypothesis("my.own", "-", 1.0, lambda w, a: w)
    assert select_user_hypotheses([*known, own]) == [own]
    for wrong, said in (([own, own], "'my.own' twice"), ([replace(own, typical=0.0)], "typical of 'my.own'; got 0")):
        with pytest.raises(InvalidInput, match=said):
            select_user_hypotheses(wrong)


def test_a_right_one_passes(world):
    _, model, setting = world
    check_user_hypotheses(
        [Hypothesis("my.own", "1/s", 1.0, lambda w, a: w.with_cloth({"mine": effects.MassDamping(a)}))],
        model.base,
        setting.episodes,
    )


def test_no_effect_may_take_the_place_of_the_catalogues(world):
    recordings, model, _ = world
    for name in ("shear_friction", "slip_left", "residual"):

        class Mine(effects.MassDamping):
            """A law of one's own."""

        register(Hypothesis("my.own", "1/s", 1.0, lambda w, a, effect=Mine, key=name: w.with_cloth({key: effect(a)})))
        try:
            with pytest.raises(InvalidInput, match=f"named '{name}', as the catalogue calls one of its own"):
                list_hypotheses(model, recordings)
        finally:
            unregister("my.own")


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"name": None}, "name of a hypothesis; got None"),
        ({"typical": "1"}, "typical of 'my.own'; got '1'; expected a number"),
        ({"apply": None}, "apply of 'my.own'"),
        ({"step_fraction": 0.0}, "step_fraction of 'my.own'"),
        (
            {"structurally_equivalent": "obs.clock"},
            "structurally_equivalent of 'my.own'; got 'obs.clock'; expected a tuple of names",
        ),
        ({"min_amplitude": 0.5}, "min_amplitude and max_amplitude of 'my.own'; got 0.5 and inf"),
        ({"max_amplitude": 0.5}, "min_amplitude and max_amplitude of 'my.own'"),
    ],
)
def test_what_cannot_be_registered(given, said):
    with pytest.raises(InvalidInput, match=said):
        register(Hypothesis(**{"name": "my.own", "unit": "-", "typical": 1.0, "apply": lambda w, a: w, **given}))


def test_a_signed_cause_is_tried_both_ways(world):
    """A search asks the other way as well, as far as the cause says that a world can have it."""
    _, model, setting = world
    braked = lambda w, a: w.with_cloth({"my": effects.MassDamping(math.sqrt(1 + 2 * a) - 1 if a else 0.0)})  # noqa: E731
    own = Hypothesis("my.own", "-", 0.8, braked, signed=True)
    with pytest.raises(InvalidInput, match=r"hypothesis 'my.own'; got ValueError"):
        check_user_hypotheses([own], model.base, setting.episodes)
    ends = replace(own, min_amplitude=0.0)
    assert not ends.is_reversible
    check_user_hypotheses([ends], model.base, setting.episodes)
    assert replace(own, min_amplitude=-0.3).opposite.typical == -0.3


def test_a_way_that_no_world_has_hides_nothing_of_the_other(world):
    """A damping less than none is refused by the library; a factor is none of a cause all the same."""
    _, model, setting = world
    apply, said = WRONG["a factor"]
    for signed in (False, True):
        with pytest.raises(InvalidInput, match=said):
            check_user_hypotheses([Hypothesis("my.own", "-", 2.0, apply, signed=signed)], model.base, setting.episodes)
