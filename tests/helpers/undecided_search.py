"""A search that ends with two confounded causes."""

from types import SimpleNamespace

import torch

from helpers import sheet_episodes
from torchcloth.diagnosis import build_base_model, fit, list_hypotheses, prepare_data
from torchcloth.diagnosis.data.binning import BLOCK_NAMES
from torchcloth.diagnosis.decide.criteria import CRITERIA
from torchcloth.diagnosis.inference.fitting import reweight_by_noise
from torchcloth.diagnosis.inference.noise import Noise


def make_undecided_search(names, list_name="causes"):
    """Return a search that ends with two confounded causes, in the list ``causes`` or ``minor``."""
    recordings = [sheet_episodes.make_episode("slow", duration=0.4), sheet_episodes.make_episode("lift", duration=0.4)]
    model = build_base_model(recordings[0])
    setting = prepare_data(model, recordings)
    hypotheses = [h for h in list_hypotheses(model, recordings) if h.name in names]
    min_slow_error = CRITERIA.noise.min_slow_error
    level = 3 * torch.tensor([min_slow_error[name] for name in BLOCK_NAMES]).double()  # large: points lie anywhere
    fitted = fit(model, setting, hypotheses, 0)
    fitted = reweight_by_noise(fitted, Noise(level), fitted.linearisation)
    hypothesis = SimpleNamespace(name=names[0])
    step = SimpleNamespace(candidate=SimpleNamespace(hypothesis=hypothesis), fit_before=fitted, scores=[])
    amplitudes = {h.name: h.typical for h in hypotheses}
    rivals = [{"effect": names[1], "amplitude": amplitudes[names[1]]}]
    cause = {"effect": names[0], "amplitude": amplitudes[names[0]], "rivals": rivals}
    steps, content = ({"causes": [], "minor": []} | {list_name: [item]} for item in (step, cause))
    equivalents = [(h, h.typical) for name in names for h in hypotheses if h.name == name]
    return SimpleNamespace(**steps, scores=[], end=fitted, equivalents=lambda _: equivalents), content, setting
