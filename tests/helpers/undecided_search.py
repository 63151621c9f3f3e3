"""A search that cannot tell two causes apart."""

from types import SimpleNamespace

import torch

from helpers import sheet_episodes
from torchcloth.diagnosis import base_model, catalogue, fit, setting_of
from torchcloth.diagnosis.data.binning import NAMES
from torchcloth.diagnosis.inference.fitting import renoised
from torchcloth.diagnosis.inference.noise import FLOOR, Noise


def undecided(names, said="causes"):
    """A search of a slow episode that ends with two causes of one class, named or too small to matter."""
    recordings = [sheet_episodes.episode("slow", duration=0.4), sheet_episodes.episode("lift", duration=0.4)]
    model = base_model(recordings[0])
    setting = setting_of(model, recordings)
    asked = [h for h in catalogue(model, recordings) if h.name in names]
    level = 3 * torch.tensor([FLOOR[name] for name in NAMES]).double()  # the points here are anywhere
    found = fit(model, setting, asked, 0)
    found = renoised(found, Noise(level), found.evidence)
    hypothesis = SimpleNamespace(name=names[0])
    step = SimpleNamespace(best=SimpleNamespace(hypothesis=hypothesis), before=found, screened=[])
    amplitudes = {h.name: h.typical for h in asked}
    rivals = [{"effect": names[1], "amplitude": amplitudes[names[1]]}]
    cause = {"effect": names[0], "amplitude": amplitudes[names[0]], "rivals": rivals}
    steps, content = ({"causes": [], "minor": []} | {said: [one]} for one in (step, cause))
    alike = [(h, h.typical) for name in names for h in asked if h.name == name]
    return SimpleNamespace(**steps, screened=[], end=found, alike=lambda _: alike), content, setting
