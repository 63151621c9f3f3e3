"""``diagnose``: all stages of a diagnosis in order."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import torch

from .._utils.files import to_json, write_text
from .._utils.resume import digest, source_fingerprint
from .._utils.torch_modes import isolated_grad_mode
from ..episodes.cloth_fingerprint import cloth_fingerprint_parts
from ..episodes.world import Hypothesis, WorldModel
from ..errors import InvalidInput
from ..inspection.corrections import check_recording
from ..recordings import Recording
from ..recordings.consistency import as_list, merge_scene
from ..recordings.fingerprints import fingerprint, reject_duplicates
from .causes.hypotheses import list_hypotheses, select_user_hypotheses
from .causes.user_hypotheses import digest_user_files
from .causes.user_hypothesis_checks import check_user_hypotheses
from .checkpointing import open_checkpoints
from .data.data_checks import check_episodes
from .data.dataset import Progress, check_positions_observed, label_motions, prefix_progress, prepare_data
from .decide.search import SearchResult, search
from .decide.verdict import Diagnosis, judge, refuse
from .experiment.feasibility import write_episode
from .experiment.proposal import propose_experiment
from .inference.lack_of_fit import measure_lack_of_fit
from .models.base_model import build_base_model
from .models.model_file import save_model
from .report.cloud_overlays import make_overlays
from .report.html_report import REPORT_FILE, write_report
from .timetable import Timetable
from .unknown.missing_force import estimate_missing_force
from .unknown.residual_force import check_against_laws, is_residual, learn_residual_force

OPEN_VERDICTS = ("ambiguous", "inconclusive", "unexplained")  # another experiment may change them
NO_EXPERIMENT_WARNING = (
    "no short motion that is possible would distinguish the causes from what they are confounded with"
)
RESULT_FILE, BASE_MODEL_FILE, EXTENDED_MODEL_FILE = "diagnosis.json", "base.tcm", "extended.tcm"
CONFIRMATION_FILE = Path("confirmation") / "confirmation.json"  # written by `torchcloth confirm`


@isolated_grad_mode()
def diagnose(
    recordings: Sequence[Recording],
    model: WorldModel | None = None,
    hypotheses: Sequence[Hypothesis] | None = None,
    progress: Progress = lambda _: None,
    journal: Path | None = None,
    resume: bool | None = False,
    checks: bool = True,
) -> Diagnosis:
    """Find what a simulation of episodes gets wrong, and what correcting it gains.

    Args:
        recordings: episodes of one cloth. Causes are named only if they show two motions (``split["motion"]``): one is
            held out while the others are fitted. With a single motion the result ranks what would explain it, names no
            cause, and proposes the motion to record next.
        model: start of the search; None: the base model of the first episode, in vacuum.
        hypotheses: what is asked about; None: the catalogue. With ``resume`` a name must mean what it meant before.
        progress: called with one line for each episode that is simulated, with the share that is done and an estimate
            of the time left.
        journal: folder for finished episodes, a few hundred kilobytes each; None: nothing is stored.
        resume: whether to continue with what a stopped diagnosis left there; the answer is the same bit by bit. None:
            start over, but refuse a folder where it could continue.
        checks: look for frozen clouds and for a clock that is off, as ``identify`` does (``inspection.corrections``).
            Frozen clouds are left out. A clock that is off is corrected, and the nuisance of that episode's clock gets
            the error of the correction. The warnings say so.

    Raises:
        InvalidInput: no episodes, different cloths, one episode twice, a default dtype other than float64, a model with
            a residual force, or hypotheses that ``register`` would refuse.
        RecordingError: an episode without data that are needed.
        SimulationDiverged: the base model cannot be simulated.
    """
    # 1. Checks of the input.
    recordings = as_list(recordings)
    motions = label_motions(recordings)
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
        return refuse(faults, motions)
    reject_duplicates(recordings)
    originals, notes, clock_stds = recordings, [], ()
    if checks:
        checked = [check_recording(recording) for recording in recordings]
        recordings, clock_stds = [c.recording for c in checked], tuple(c.clock_std for c in checked)
        notes = [note for c in checked for note in c.notes]

    # 2. Model and hypotheses, and a fingerprint of everything that was decided before the first simulation.
    model = model or build_base_model(merge_scene(recordings))
    asked = list_hypotheses(model, recordings) if hypotheses is None else list(hypotheses)
    user_hypotheses = select_user_hypotheses(asked)
    plan_hash = _fingerprint_plan(model, asked, motions)

    # 3. Data on both meshes.
    data = replace(prepare_data(model, recordings), clock_stds=clock_stds)
    check_positions_observed(data)
    for mesh_data in (data, data.fine_mesh):
        if mesh_data is not None:
            check_user_hypotheses(user_hypotheses, mesh_data.base, mesh_data.episodes)
    if journal is not None:
        data = replace(data, cache=open_checkpoints(journal, model, data, resume))

    # 4. Search, doubt, unknowns, verdict, proposal. Simulations run in parallel, so torch's own threads would only
    # wait.
    threads = torch.get_num_threads()
    durations = [float(e.times[-1] - e.times[0]) for e in data.episodes]
    progress = Timetable(durations, len(set(motions)) > 1).wrap(progress)
    with _torch_threads(1):
        result = search(model, data, asked, progress)
        result = check_against_laws(result, prefix_progress(progress, "laws without a cause"))
        answer = _judge_with_unknowns(result, threads, progress)
        proposal = None
        if answer.verdict in OPEN_VERDICTS:
            stage = prefix_progress(progress, "next experiment")
            proposal = propose_experiment(result, answer.content, data, stage)
        overlays = make_overlays(answer.search, progress)
    has_no_experiment = answer.verdict == "ambiguous" and not proposal
    description, episode = proposal or (None, None)
    content = {
        **answer.content,
        "plan_hash": plan_hash,
        "base": BASE_MODEL_FILE,
        "model": EXTENDED_MODEL_FILE,
        "episodes": [fingerprint(r) for r in originals],
        "next_experiment": description,
        "warnings": [*notes, *answer.content["warnings"], *([NO_EXPERIMENT_WARNING] if has_no_experiment else [])],
    }
    return replace(answer, content=content, overlays=overlays, experiment=episode)


def _fingerprint_plan(model: WorldModel, asked: Sequence[Hypothesis], motions: Sequence[str]) -> str:
    """Return a fingerprint of everything that was decided before the first simulation.

    The sources contain all thresholds. The rest is the base model's cloth, its parameters with their priors, the causes
    that it comes with, the hypotheses with their smallest effects of interest, the files of user hypotheses, and which
    episodes are held out together.
    """
    parameters = [(p.name, p.unit, p.prior_std, p.step, p.min_coordinate, p.max_coordinate) for p in model.parameters]
    causes = [[(h.name, h.unit, *h.amplitude_settings) for h in hypotheses] for hypotheses in (model.accepted, asked)]
    cloth = cloth_fingerprint_parts(model.base.cloth)
    code = [source_fingerprint(), *digest_user_files()]
    return digest([*code, *cloth, parameters, model.point, *causes, list(motions)])


@contextmanager
def _torch_threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _judge_with_unknowns(result: SearchResult, threads: int, progress: Progress) -> Diagnosis:
    """Derive the verdict, with the missing force and the residual force where no known cause suffices."""
    rows = measure_lack_of_fit(result.end, result.data.motions)
    is_inadequate, meshes_agree = any(row.is_significant for row in rows), all(row.meshes_agree for row in rows)
    missing_force = None
    if is_inadequate:
        with _torch_threads(threads):  # one episode at a time, whose directions share the threads
            missing_force = estimate_missing_force(result.end, result.data, progress=progress)
    # laws find more than the lack of fit, because they know what it would look like
    needs_laws = result.has_held_out_motions and (is_inadequate or (meshes_agree and not result.causes))
    stage = prefix_progress(progress, "force laws")
    residual_force = learn_residual_force(result.end, result.data, stage) if needs_laws else None
    return judge(result, result.data.motions, missing_force, residual_force)


def write_diagnosis(answer: Diagnosis, recordings: Sequence[Recording], folder: Path) -> Diagnosis:
    """Write diagnosis.json, report.html and, unless data are invalid, the models.

    A proposed experiment is written as an episode beside them, ``next_experiment``, without measurements. If it cannot
    be written, a warning says so.

    Args:
        answer: the diagnosis.
        recordings: the episodes, which describe the base model's cloth.
        folder: made if it does not exist.

    Returns:
        The diagnosis as written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name in (RESULT_FILE, REPORT_FILE, CONFIRMATION_FILE):  # those of an earlier diagnosis are about other models
        (folder / name).unlink(missing_ok=True)
    if answer.optional_search is None:
        for name in (BASE_MODEL_FILE, EXTENDED_MODEL_FILE):
            (folder / name).unlink(missing_ok=True)
    else:
        start, end, scene = answer.search.start, answer.search.end, merge_scene(recordings)
        fingerprints = [*start.model.episode_fingerprints, *answer.content["episodes"]]
        laws = answer.residual_force
        residual = laws.model if laws is not None and laws.terms else None
        save_model(folder / BASE_MODEL_FILE, start.model, scene, start.covariance, episodes=fingerprints)
        save_model(folder / EXTENDED_MODEL_FILE, end.model, scene, end.covariance, residual, fingerprints)
    if warning := write_episode(answer.experiment, folder):
        answer = replace(answer, content=answer.content | {"warnings": [*answer.content["warnings"], warning]})
    write_text(folder / RESULT_FILE, to_json(answer.content))
    write_report(answer, folder)
    return answer
