"""``diagnose``: all stages in order."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import torch

from .._utils.files import to_json, write_text
from .._utils.resume import digest, source_fingerprint
from .._utils.torch_modes import isolated_grad_mode
from ..episodes.cloth_facts import cloth_fingerprint_parts
from ..episodes.world import Hypothesis, Model
from ..errors import InvalidInput
from ..recordings import Recording
from ..recordings.consistency import listed, together
from ..recordings.fingerprints import each_once, mark
from .causes.hypotheses import catalogue, own_among
from .causes.user_hypotheses import digests
from .causes.user_hypothesis_checks import check_own
from .checkpointing import kept_in
from .data.data_checks import check_episodes
from .data.dataset import Progress, label_motions, prepare_data, check_positions_observed, prefix_progress
from .decide.search import SearchResult, search
from .decide.verdict import Diagnosis, judge, refuse
from .experiment.feasibility import write_episode
from .experiment.proposal import propose
from .inference.lack_of_fit import measure_lack_of_fit
from .models.base_model import base_model
from .models.model_file import save_model
from .report.cloud_overlays import make_overlays
from .report.html_report import REPORT, write_report
from .unknown.missing_force import missing_force
from .unknown.residual_force import check_against_laws, is_residual, learn_residual_force

OPEN = ("ambiguous", "inconclusive", "unexplained")  # verdicts that another experiment may change
NONE_TELLS = "no short motion that can be done would tell the causes from what they cannot be told from now"
RESULT, BASE, EXTENDED = "diagnosis.json", "base.tcm", "extended.tcm"
CONFIRMED = Path("confirmation") / "confirmation.json"  # where `torchcloth confirm` says what they gain


@isolated_grad_mode()
def diagnose(
    recordings: Sequence[Recording],
    model: Model | None = None,
    hypotheses: Sequence[Hypothesis] | None = None,
    progress: Progress = lambda _: None,
    journal: Path | None = None,
    resume: bool | None = False,
) -> Diagnosis:
    """What a simulation of these episodes gets wrong, and what mending it gains.

    Args:
        recordings: episodes of one cloth, at least two, of different motions (``split["motion"]``).
        model: where to start; None: the base model of the first episode, in vacuum.
        hypotheses: what to look for; None: the catalogue. With ``resume`` a name must mean what it did.
        progress: called with one line for each episode that is simulated.
        journal: folder for finished episodes, a few hundred kilobytes each; None: nothing is kept.
        resume: go on with what a diagnosis that was stopped left there; the answer is the same, bit by bit. None: start
            over, but refuse to where it could go on.

    Raises:
        InvalidInput: fewer than two episodes, too few motions to hold one out, different cloths, one episode twice, a
            default dtype other than float64, a model with a residual force, or hypotheses that ``register`` would
            refuse.
        RecordingError: an episode that lacks what is needed.
        SimulationDiverged: the base model cannot be simulated.
    """
    recordings = listed(recordings)
    names = label_motions(recordings)
    if len(set(names)) < 2:
        each_once(recordings)  # a copy needs no other name
        raise InvalidInput(
            "episodes",
            got=f"{len(recordings)} with motion {', '.join(sorted(set(names))) or 'none'}",
            expected="at least two motions: one is held out while the other is fitted",
            remedy="record another motion, or name them apart (split.motion in episode.json)",
        )
    if torch.get_default_dtype() != torch.float64:
        raise InvalidInput(
            "default dtype",
            got=torch.get_default_dtype(),
            expected="torch.float64: differences between simulations lose their digits in float32",
            remedy="torch.set_default_dtype(torch.float64)",
        )
    if model is not None and any(map(is_residual, model.accepted)):
        raise InvalidInput(
            "model",
            got="one with a residual force, which is no cause",
            expected="one without",
            remedy="load_model(path, residual=False)",
        )
    if faults := check_episodes(recordings):
        return refuse(faults, names)
    each_once(recordings)
    model = model or base_model(together(recordings))
    asked = catalogue(model, recordings) if hypotheses is None else list(hypotheses)
    own = own_among(asked)
    plan = _plan(model, asked, names)
    setting = prepare_data(model, recordings)
    check_positions_observed(setting)
    for place in (setting, setting.fine_mesh):  # each with a mesh of its own
        if place is not None:
            check_own(own, place.base, place.episodes)
    if journal is not None:
        setting = replace(setting, kept=kept_in(journal, model, setting, resume))
    many = torch.get_num_threads()
    with _threads(1):  # simulations run side by side: threads for the small arrays of each would wait for each other
        found = check_against_laws(search(model, setting, asked, progress), prefix_progress(progress, "laws without a cause"))
        answer = _judged(found, many, progress)
        proposal = None
        if answer.verdict in OPEN:
            proposal = propose(found, answer.content, setting, prefix_progress(progress, "next experiment"))
        over = make_overlays(answer.search, progress)
    warnings = [*answer.content["warnings"], *([NONE_TELLS] if answer.verdict == "ambiguous" and not proposal else [])]
    files = {"plan_hash": plan, "base": BASE, "model": EXTENDED, "episodes": [mark(r) for r in recordings]}
    following, episode = proposal or (None, None)
    said = answer.content | files | {"next_experiment": following, "warnings": warnings}
    return replace(answer, content=said, overlays=over, experiment=episode)


def _plan(model: Model, asked: Sequence[Hypothesis], names: Sequence[str]) -> str:
    """A fingerprint of what was decided before anything was simulated.

    The sources hold all thresholds; beside them the base model's cloth and numbers with their priors, the causes that
    it comes with, what is asked about and from what size it matters, whose causes those are, and which episodes are
    held out together.
    """
    numbers = [(p.name, p.unit, p.std, p.step, p.low, p.high) for p in model.parameters]
    causes = [[(h.name, h.unit, *h.sizes) for h in hypotheses] for hypotheses in (model.accepted, asked)]
    return digest([source_fingerprint(), *digests(), *cloth_fingerprint_parts(model.base.cloth), numbers, model.point, *causes, list(names)])


@contextmanager
def _threads(count: int) -> Iterator[None]:
    """So many of torch's."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _judged(found: SearchResult, threads: int, progress: Progress) -> Diagnosis:
    """With what can be said of what no known cause explains."""
    left = measure_lack_of_fit(found.end, found.data.motions)
    lacking, stable = any(row.is_significant for row in left), all(row.meshes_agree for row in left)
    missing = None
    if lacking:
        with _threads(threads):  # an episode at a time, whose directions the threads share
            missing = missing_force(found.end, found.data, progress=progress)
    # laws tell of more than what is left: they know what it would look like
    learned = lacking or (stable and not found.causes)
    residual = learn_residual_force(found.end, found.data, progress) if learned else None
    return judge(found, found.data.motions, missing, residual)


def write_diagnosis(answer: Diagnosis, recordings: Sequence[Recording], folder: Path) -> Diagnosis:
    """Write diagnosis.json, report.html and, unless data are invalid, the models; returns the answer as written.

    An experiment that is proposed becomes an episode beside them, ``next_experiment``, of which nothing is seen yet; a
    warning says where it could not.
    ``recordings`` are the episodes, which say what the base model is of.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name in (RESULT, REPORT, CONFIRMED):  # of an earlier diagnosis: they say nothing of other models
        (folder / name).unlink(missing_ok=True)
    if answer.optional_search is None:
        for name in (BASE, EXTENDED):
            (folder / name).unlink(missing_ok=True)
    else:
        said, scene = [*answer.search.start.model.met, *answer.content["episodes"]], together(recordings)
        residual = answer.residual_force.model if answer.residual_force is not None and answer.residual_force.terms else None
        start, end = answer.search.start, answer.search.end
        save_model(folder / BASE, start.model, scene, start.covariance, episodes=said)
        save_model(folder / EXTENDED, end.model, scene, end.covariance, residual, said)
    if warning := write_episode(answer.experiment, folder):
        answer = replace(answer, content=answer.content | {"warnings": [*answer.content["warnings"], warning]})
    write_text(folder / RESULT, to_json(answer.content))
    write_report(answer, folder)
    return answer
