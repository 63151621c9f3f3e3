"""One declaration of an effect's size: priors, hypotheses, glossary and reserved names follow from it."""

from dataclasses import fields
from fnmatch import fnmatchcase

import pytest
import torch

import torchcloth as tc
from torchcloth.diagnosis import Hypothesis, build_base_model
from torchcloth.diagnosis.causes.catalogue import CATALOGUE, list_effect_classes, list_undeclared_causes
from torchcloth.diagnosis.causes.glossary import EQUIVALENT_CAUSES, GLOSSARY, format_catalogue
from torchcloth.diagnosis.causes.hypotheses import RESERVED_EFFECT_NAMES
from torchcloth.effects import AbstractEffect, Amplitude
from torchcloth.errors import InvalidInput
from torchcloth.recordings import read

EXAMPLE = "torchcloth/examples/bimanual_swing"
DECLARED = [(effect, name, a) for effect in list_effect_classes() for name, a in effect.amplitudes.items()]


class Jet(AbstractEffect):
    """A constant force; its second parameter is not asked about."""

    amplitudes = {
        "pressure": Amplitude(
            unit="Pa",
            typical=1.0,
            smallest=0.2,
            confounded_with=("air.wind",),
            cause="my.air.jet",
            title="Jet",
            description="It blows.",
        ),
        "width": Amplitude(unit="m", typical=0.1),
    }

    def __init__(self, pressure=1.0, width=0.1):
        super().__init__()
        self.pressure = tc.PhysicalParameter(pressure, "Pa", "nonnegative", name="pressure of a jet")
        self.width = tc.PhysicalParameter(width, "m", "nonnegative", name="width of a jet")

    def coefficients(self):
        return self.pressure.field


@pytest.fixture(scope="module")
def model():
    torch.set_default_dtype(torch.float64)
    return build_base_model(read(EXAMPLE))


@pytest.mark.parametrize(
    "amplitude", [a for _, _, a in DECLARED if a.cause], ids=[a.cause for _, _, a in DECLARED if a.cause]
)
def test_a_declared_cause_is_in_the_catalogue(amplitude):
    hypotheses = [h for h in CATALOGUE if h.effect == amplitude.cause]
    assert hypotheses
    for h in hypotheses:
        assert (h.unit, h.typical, h.signed) == (amplitude.unit, amplitude.typical_of_cause, amplitude.signed)
        assert (h.smallest_fraction, h.title, h.description) == (0.4, amplitude.title, amplitude.description)


def test_what_is_confounded_exists():
    """Names are causes, or parameters that fits can estimate: of an effect by its class, else of the cloth."""
    parameters = {f"{effect.__name__}.{parameter}" for effect, parameter, _ in DECLARED}
    known = GLOSSARY.keys() | EQUIVALENT_CAUSES.keys() | parameters
    for effect, parameter, amplitude in DECLARED:
        unknown = [name for name in amplitude.confounded_with if name not in known]
        assert not unknown, f"{effect.__name__}.{parameter} names {unknown}"
        assert amplitude.cause not in amplitude.confounded_with
    names = {h.name for h in CATALOGUE} | EQUIVALENT_CAUSES.keys()
    assert all({*h.structurally_equivalent, *filter(None, [h.implies])} <= names for h in CATALOGUE)


def test_every_cause_has_words():
    assert all(h.title and h.description for h in CATALOGUE)
    names = [h.name for h in CATALOGUE]
    assert len(names) == len(set(names))


@pytest.mark.parametrize("hypothesis", CATALOGUE, ids=lambda h: h.name)
def test_the_effects_of_a_cause_have_the_declared_names(model, hypothesis):
    before = dict(model.base.cloth.effects.items())
    after = dict(hypothesis.apply_to(model.base, hypothesis.typical).cloth.effects.items())
    changed = {name for name, effect in after.items() if type(effect) is not type(before.get(name))}
    patterns = set(hypothesis.effect_names)
    assert all(any(fnmatchcase(name, pattern) for pattern in patterns) for name in changed)
    assert patterns <= RESERVED_EFFECT_NAMES


def test_a_new_effect_is_asked_about_by_its_declaration(model):
    (hypothesis,) = list_undeclared_causes([*list_effect_classes(), Jet], CATALOGUE)
    assert (hypothesis.name, hypothesis.unit, hypothesis.typical) == ("my.air.jet", "Pa", 1.0)
    assert hypothesis.smallest_of_interest == 0.2
    assert "| `my.air.jet` | 1 Pa | It blows. |" in format_catalogue([hypothesis])
    jet = hypothesis.apply_to(model.base, 0.5).cloth.effects["air_jet"]
    assert jet.pressure.value.item() == 0.5


def test_a_declaration_is_read_as_a_hypothesis():
    h = Hypothesis.from_amplitude(Jet, axis="x", effect_name="jet", needs_fine_mesh=True, smallest_fraction=0.3)
    assert (h.name, h.effect, h.effect_names) == ("my.air.jet[x]", "my.air.jet", ("jet",))
    assert h.needs_fine_mesh
    assert h.smallest_fraction == 0.3
    with pytest.raises(InvalidInput, match=r"parameter of Jet; got 'speed'; expected one of pressure, width"):
        Hypothesis.from_amplitude(Jet, "speed")
    with pytest.raises(InvalidInput, match=r"amplitude 'width' of Jet; got no cause"):
        Hypothesis.from_amplitude(Jet, "width")
    assert {"title", "description", "effect_names"} <= {f.name for f in fields(Hypothesis)}


def test_a_prior_and_a_diagnosis_may_call_different_amounts_typical():
    rate = tc.effects.MassDamping.amplitudes["rate"]
    assert (rate.typical, rate.typical_of_cause, rate.smallest_fraction) == (1.0, 2.0, 0.4)
    assert Amplitude(unit="m", typical=-2.0, smallest=0.5, signed=True).smallest_fraction == 0.25
