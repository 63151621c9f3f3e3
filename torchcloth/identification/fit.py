"""``identify``: fit the parameters of a cloth to recordings."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, cast

from torch import Tensor

from .._utils.resume import ResumableStore
from .._utils.torch_modes import isolated_grad_mode
from ..cloth import Cloth
from ..effects import AbstractEffect
from ..episodes.observed import Episode, build_episode, check_recordings, require_cpu
from ..episodes.replay import Frames
from ..episodes.unknowns import apply_priors, collect_unknowns
from ..errors import InvalidInput
from ..inspection.corrections import check_all
from ..parameters import PhysicalParameter
from ..recordings import Recording
from .estimators import levenberg_marquardt
from .estimators.convergence import find_limit_reasons
from .estimators.linearity import LinearityCheck
from .estimators.objective import Objective
from .estimators.search import CHAMFER_METHODS, ESTIMATION_METHODS, Method, Outcome, Progress, Search
from .fit_warnings import fit_warnings, nuisance_warnings, warn_of_skew
from .io.saved_fit import describe_model
from .nuisances import GripExtent, add_lookahead, as_stds, bench_nuisances, implied_nuisances, select_nuisances
from .residuals.blocks import select_blocks
from .residuals.metrics import distance_metrics, force_rms
from .residuals.rigid_carry import carry_rigidly, find_unbeaten_null, mean_forces, zero_forces
from .result import Identification
from .uncertainty.consider_covariance import shared_misfit, solution_covariance
from .uncertainty.estimates import apply_profiles, make_estimates, make_nuisance_estimates, withdraw_estimates
from .uncertainty.identifiability import describe_influences, find_combinations
from .uncertainty.likely_reasons import describe_reasons, rank_reasons
from .uncertainty.misfit import estimate_point_noise, find_misfit
from .uncertainty.model_error import MODEL_ERRORS, ModelErrors, add_model_error
from .uncertainty.profile_likelihood import compute_profiles
from .uncertainty.replicates import assign_strata
from .uncertainty.richardson import FineScene, correct_for_mesh, refine_cloth

DEFAULT_MAX_ITERATIONS = 35  # of the DiffCP paper
MAX_STARTS = 1000
NO_PROFILE_REASON = "the motion can be predicted for a while only, or by simulations spread around the solution"
NO_PROFILE_OF_MISFIT_REASON = "the model does not describe these data"


@isolated_grad_mode()
def identify(
    cloth: Cloth,
    recordings: Recording | Sequence[Recording],
    parameters: Sequence[str] | None = None,
    *,
    method: Method = "gauss-newton",
    stop: Literal["converged", "paper"] = "converged",
    iterations: int = DEFAULT_MAX_ITERATIONS,
    rate: float = 0.1,
    guess: Mapping[str, float] | None = None,
    warm_start: bool = False,
    dt: float | None = None,
    use: Sequence[str] | None = None,
    nuisances: Mapping[str, float | None] | Sequence[str] = (),
    priors: Mapping[str, tuple[float, float]] | None = None,
    noise: Mapping[str, float] | None = None,
    starts: int = 1,
    profile: Sequence[str] = (),
    journal: str | Path | None = None,
    resume: bool | None = False,
    on_progress: Progress | None = None,
    refine: bool = False,
    checks: bool = True,
    exact_bench: bool = False,
    model_errors: ModelErrors = MODEL_ERRORS,
) -> Identification:
    """Fit scalar parameters of a cloth to points, markers and forces, by gradients through the simulation.

    Args:
        cloth: model and start values; left unchanged (see ``Identification.apply``).
        recordings: one or several episodes of the same cloth.
        parameters: public names, e.g. ["youngs_modulus", "air.normal"]; None: all material parameters that are not
            zero, and the first amplitude of each effect.
        method: "gauss-newton" (Levenberg-Marquardt on robust residuals, forward-mode sensitivities) or "lbfgs" (the
            same cost, reverse mode). "adam" and "gradient-descent" minimise the paper's Chamfer distance to vertices
            (reverse mode), for comparison. A distance has no noise model, so these two take neither priors nor
            nuisances, and they take the density as exact.
        stop: "converged", or "paper": as soon as the paper's Chamfer distance (one-sided, to vertices) is below 1.5 cm.
        iterations: largest number of iterations on all frames. At most 10 on the early frames come before. These are
            the beginning of the same motion, so neither velocity nor rest shape is ever reset.
        rate: of "adam" and "gradient-descent": 0.1 is about 10 % a step, of an amplitude's typical size.
        guess: values by name to start the search from, e.g. of an interrupted fit. The result is still compared with
            the cloth's own values as the start.
        warm_start: the guess is near the solution (an interrupted fit): skip the stage on the early frames.
        dt: largest substep [s]; None: the stable one, chosen anew for every set of values.
        use: kinds of data, some of "points", "markers" and "force"; None: all that an episode has.
        nuisances: what may differ from episode to episode, as names, or with the standard deviation of the prior, e.g.
            {"clock": 0.4}: "clock" [s], "jitter" of single stamps [s], "camera" [m], "rim" of the cloud [m], "grasp"
            [m], "grasp_turn" [rad], "grip" [m], "shape" [m], "tare" [N]. Those that every bench has join anyway, unless
            they are given as 0 (see ``exact_bench``).
        priors: by parameter (value, factor) for positive ones: 68 % within that factor; (value, standard deviation)
            for others. Default: around the start, a factor of 10 for positive parameters, 1 in the logit of 2 nu, twice
            the typical size of amplitudes.
        noise: least standard deviation by kind of data: "points", "edges", "markers" [m], "force" [N], "torque" [N m].
        starts: number of starts: the given one and others over two decades of every positive parameter. Each is
            followed on the early frames, and the best goes on. ``fit["starts_agreeing"]`` counts those that led to the
            same values.
        profile: names of fitted parameters whose profile likelihood is computed, for intervals that may be skew or
            open. Each costs some 20 simulations for every unknown of the fit.
        journal: folder in which the fit stores what it computed. It is of no use once the result is saved.
        resume: continue where a fit with this journal was stopped; the result is bit by bit that of an uninterrupted
            fit. None: start over, but refuse to if the journal could be continued.
        on_progress: called with (iteration, Chamfer distance, values, fraction of the frames in use) after every
            iteration; the distance is NaN if there are no points.
        refine: correct the result for the coarseness of the mesh by one simulation on a mesh twice as fine, and widen
            its errors by what that leaves open (see ``uncertainty.richardson``). ``fit["mesh_correction"]`` has the
            largest correction in standard errors. It is not applied where the motion is chaotic, and not together
            with ``profile``.
        checks: look for frozen clouds and for a clock that is off (``inspection.corrections``). Frozen clouds are left
            out. A clock that is off is corrected, and becomes a nuisance. The warnings say so.
        exact_bench: take the stamps, the camera's pose, the grips and the first shape as exact, as in a simulation of
            one's own. By default "clock", "jitter", "camera", "grasp", "grip" and "shape" join the nuisances where the
            data have them (``nuisances.bench_nuisances``); "rim" joins always.
        model_errors: what the parameters of two simulators of one cloth differ by; standard errors include it. Zeros
            suit data from this very simulator only.

    Returns:
        Estimates with standard errors, distances, warnings, frames.

    Raises:
        InvalidInput: unknown names or options, or one episode twice.
        RecordingError: a recording without motion, without data, or in another unit than metres.
        SimulationDiverged: the start values cannot be simulated.
    """
    _check_options(method, stop, iterations, starts)
    if not 0 < rate < math.inf:
        raise InvalidInput("rate", got=rate, expected="a number > 0")
    _check_chamfer_options(method, priors, nuisances, use)
    began = time.perf_counter()
    require_cpu(cloth)
    originals = recordings = check_recordings(recordings)
    notes, clock_std = [], None
    if checks:
        recordings, notes, clock_std = check_all(recordings)
    if refine and profile:
        raise InvalidInput("profile", got="refine as well", expected="one of them: a profile is that of the given mesh")
    fine_scene = FineScene(refine_cloth(cloth), recordings) if refine else None

    parameters = [parameters] if isinstance(parameters, str) else parameters
    names = default_parameters(cloth) if parameters is None else list(parameters)
    weighed = None if method in CHAMFER_METHODS else recordings[0].cloth.measured_areal_density  # joins as a prior
    unknowns = apply_priors(collect_unknowns(cloth, names, weighed), priors or {})
    if not unknowns:
        raise InvalidInput("parameters", got="none", expected="at least one name")
    _check_profile(profile, [u.name for u in unknowns])

    blocks = select_blocks(use)
    episodes = [build_episode(cloth, r) for r in recordings]
    _check_has_points(method, stop, episodes)
    uses = [block.name for block in blocks]
    expected: dict[str, float | None] = {}
    if method == "gauss-newton" and not exact_bench:
        expected = bench_nuisances(uses, episodes)
    if clock_std is not None and method not in CHAMFER_METHODS:
        expected["clock"] = max(clock_std, expected.get("clock") or 0.0)
    selected = select_nuisances(expected | as_stds(nuisances), implied_nuisances(uses, episodes))
    objective = Objective(cloth, unknowns, add_lookahead(episodes, selected), dt, selected, blocks, noise)
    start = objective.start_with(guess or {})
    if journal is not None:
        options = [method, stop, rate, starts]
        objective.journal = ResumableStore(journal, [*options, *objective.fingerprint_parts(), start], resume)

    noise_std = estimate_point_noise(recordings)
    search = Search(objective, stop, on_progress, assign_strata(recordings), noise_std)
    before = objective.observe(objective.start)
    outcome = search.run(method, start, iterations, rate, not warm_start and stop != "paper", starts)
    fit = _assemble_result(search, before, outcome, began, profile, fine_scene, model_errors, noise_std)
    model = describe_model(cloth, fit, originals, recordings, dt)
    return replace(fit, model=model, recordings=list(recordings), warnings=[*notes, *fit.warnings])


def _check_options(method: str, stop: str, iterations: int, starts: int) -> None:
    if method not in ESTIMATION_METHODS or stop not in ("converged", "paper"):
        expected = f'{", ".join(map(repr, ESTIMATION_METHODS))}; "converged" or "paper"'
        raise InvalidInput("method or stop", got=f"{method!r}, {stop!r}", expected=expected)
    for name, number in (("iterations", iterations), ("starts", starts)):
        if not isinstance(number, int) or number < 1:
            raise InvalidInput(name, got=number, expected="at least 1, and whole")
    if starts > MAX_STARTS:
        raise InvalidInput("starts", got=starts, expected=f"at most {MAX_STARTS}")
    if starts > 1 and method in CHAMFER_METHODS:
        raise InvalidInput(
            "starts",
            got=f"{starts} with method {method!r}",
            expected="1: several are compared by Gauss-Newton, with its priors, and not by the Chamfer distance alone",
            remedy='method "gauss-newton" or "lbfgs"',
        )


def _check_chamfer_options(
    method: str,
    priors: Mapping[str, Any] | None,
    nuisances: Mapping[str, Any] | Sequence[str],
    use: Sequence[str] | None,
) -> None:
    """Refuse options that a mean distance cannot be weighed against: priors need a noise model.

    A search without them would go where they forbid, and report errors that include them. Nor does it choose among
    kinds of data.
    """
    for name, option in (("priors", priors), ("nuisances", nuisances), ("use", use)):
        if method in CHAMFER_METHODS and option:
            raise InvalidInput(
                name,
                got=f"{', '.join(option)} with method {method!r}",
                expected="none: it follows the Chamfer distance alone",
                remedy='method "gauss-newton" or "lbfgs"',
            )


def _check_profile(names: Sequence[str], fitted: Sequence[str]) -> None:
    for name in names:
        if name not in fitted:
            raise InvalidInput("profile", got=repr(name), expected=f"some of {', '.join(fitted)}")


def _check_has_points(method: str, stop: str, episodes: Sequence[Episode]) -> None:
    """Refuse methods that follow the Chamfer distance where there are no points."""
    for e in episodes:
        has_points = any(len(e.observed_points(t)) for t in range(len(e.times)))
        if (method in CHAMFER_METHODS or stop == "paper") and not has_points:
            raise InvalidInput(
                f"{e.name}: method {method!r}, stop {stop!r}",
                got="an episode with neither points nor markers",
                expected="points or markers, of which it takes the Chamfer distance",
                remedy='method "gauss-newton" or "lbfgs", stop "converged"',
            )


def default_parameters(cloth: Cloth) -> list[str]:
    """Return names of membrane parameters, of contact parameters if there is contact, and of main amplitudes.

    Others (damping times, wind, curl) are fitted when they are named.
    """
    material = {name: part for name, part in cloth.material.named_modules() if isinstance(part, PhysicalParameter)}
    names = [name for name, part in material.items() if bool((part.value != 0).any())]
    if cloth.contact is None:
        names = [name for name in names if name not in cloth.material.contact_parameters]
    for key, effect in cast("Iterable[tuple[str, AbstractEffect]]", cloth.effects.items()):
        main = next(iter(effect.amplitudes))
        parameter = getattr(effect, main)
        if isinstance(parameter, PhysicalParameter) and parameter.raw.ndim == 0:  # a residual force has several
            names.append(f"{key}.{main}")
    return names


def _assemble_result(
    search: Search,
    start: list[Frames],
    outcome: Outcome,
    began: float,
    profile: Sequence[str],
    fine_scene: FineScene | None,
    model_errors: ModelErrors,
    noise_std: float,
) -> Identification:
    """Turn the end of a search into estimates, distances and warnings."""
    full, used, checked = search.objective, outcome.objective_used, outcome.checked
    final, warnings = checked.final, list(checked.warnings)

    # a solution that means nothing gets no simulation for its errors
    before, null = [s.x for s in start], [carry_rigidly(e) for e in full.episodes]
    chamfer_before = distance_metrics(before, full.episodes, full.faces).chamfer
    misfit_reason, likely_reasons = _find_misfit(full, used, final, chamfer_before, noise_std)
    if misfit_reason:
        checked = checked._replace(failure_reason=misfit_reason)

    # covariance, and the correction for the mesh
    covariance = solution_covariance(used, checked, search.strata)
    is_regular = not checked.is_withdrawn and checked.covariance is None
    corrected = correct_for_mesh(full, final, covariance, fine_scene if is_regular and used is full else None)
    final, covariance = corrected.final, corrected.covariance
    warnings += corrected.warnings
    end = full.observe(final.raw)
    after = [s.x for s in end]

    # estimates, with profiles where the whole motion is regular
    total_covariance = add_model_error(full.unknowns, final.raw, covariance, model_errors, _has_unknown_grips(full))
    estimates = make_estimates(full.cloth, full.unknowns, final.raw, total_covariance)
    has_profiles = not (checked.warnings or checked.is_withdrawn)
    profiles = compute_profiles(used, final, covariance, profile, search.report_progress) if has_profiles else {}
    if profile and not has_profiles:
        why = NO_PROFILE_OF_MISFIT_REASON if misfit_reason else NO_PROFILE_REASON
        warnings.append(f"no profile of {', '.join(profile)}: {why}")
    estimates = apply_profiles(estimates, profiles)

    # distances and counts
    fit: dict[str, Any] = _distance_entries(full, {"before": before, "after": after, "null": null})
    fit |= _force_entries(full, start, end)
    fit |= {
        "iterations": max(0, len(search.history) - 1),
        "simulations": search.simulations,
        "seconds": time.perf_counter() - began,
        "points": sum(len(c) for e in full.episodes for c in e.clouds),
        "points_noise": noise_std,
        "stable_step": full.cloth.stable_step(),
        "converged": final.converged,
        "stamp_std": 0.0 if full.frame_times is None else full.frame_times.std,
        **_observation_entries(used, final),
        **corrected.entries,
    }
    if search.strata is not None and bool((search.strata > 0).any()):
        fit["replicates"] = int((search.strata > 0).sum())
    if outcome.multistart is not None:
        fit |= {"starts": outcome.multistart.simulated, "starts_agreeing": outcome.multistart.agreeing}

    # withdrawal and warnings
    unbeaten_null = find_unbeaten_null(full, end)
    if corrected.entries:  # it moved the solution
        misfit_reason, likely_reasons = _find_misfit(full, used, final, chamfer_before, noise_std)
    limits = find_limit_reasons(full.unknowns, final.raw)
    warnings += [
        f"{reason}: no estimate of {', '.join(n for n in limits if limits[n] == reason)}"
        for reason in dict.fromkeys(limits.values())
    ]
    is_withdrawn = checked.is_withdrawn or bool(unbeaten_null or misfit_reason)
    fit["withdrawn"] = is_withdrawn
    if is_withdrawn:  # slopes of chaos, or far from the optimum, promise tiny errors
        estimates = withdraw_estimates(estimates, full.unknowns, final.raw)
    elif unusable := _unusable_parameters(full, checked, profiles) | set(limits) | set(corrected.unusable):
        estimates = withdraw_estimates(estimates, full.unknowns, final.raw, unusable)
    warnings += [reason for reason in (misfit_reason, outcome.unfinished_reason) if reason]
    warnings += warn_of_skew(estimates, [name for name in checked.curved_parameters if name not in profiles])
    used_frames = [x[: len(e.times)] for x, e in zip(after, used.episodes, strict=True)]
    fit_of_used = {**fit, "rms_after": distance_metrics(used_frames, used.episodes, full.faces).rms}
    if not full.uses("points", "markers"):  # points that were not used are reported, and decide nothing
        fit_of_used |= {"rms_after": math.nan, "chamfer_after": math.nan}
    warnings += nuisance_warnings(full.episodes, full.nuisance_slices, final.raw)
    warnings += fit_warnings(full.cloth, full.episodes, estimates, fit_of_used, after, full.faces, unbeaten_null)

    return Identification(
        parameters=estimates.parameters,
        fit=fit,
        correlation=estimates.correlation,
        warnings=warnings,
        history=search.history,
        frames_before=_observed_frames(before, full),
        frames_after=_observed_frames(after, full),
        frames_null=_observed_frames(null, full),
        keys={u.name: u.key.removesuffix(".raw") for u in full.unknowns},
        nuisances=make_nuisance_estimates(full.episodes, full.nuisance_slices, final.raw, covariance, is_withdrawn),
        influences=describe_influences(full.unknowns, final.raw, checked.influence, estimates.parameters),
        combinations=[] if is_withdrawn else find_combinations(full.unknowns, final.raw, total_covariance),
        profiles=profiles,
        likely_reasons=likely_reasons,
        forces_before=[_observed_forces(s.wrench, e) for s, e in zip(start, full.episodes, strict=True)],
        forces_after=[_observed_forces(s.wrench, e) for s, e in zip(end, full.episodes, strict=True)],
    )


def _has_unknown_grips(objective: Objective) -> bool:
    return any(isinstance(nuisance, GripExtent) for nuisance in objective.nuisances)


def _unusable_parameters(full: Objective, checked: LinearityCheck, profiles: Mapping[str, Any]) -> set[str]:
    """Return parameters that are no estimates: their slopes fail, or change where the grips are unknown, too.

    Flat directions towards the errors of a bench are curved. At a rig with a clamp E h ended at 3.3 ± 0.6 of the truth,
    with slopes that change within a standard error (``studies strangers``, seed 6).
    """
    known = {u.name for u in full.unknowns if u.measured}
    curved = set(checked.curved_parameters) - set(profiles) - known if _has_unknown_grips(full) else set()
    return set(checked.unusable_parameters) | curved


def _find_misfit(
    full: Objective, used: Objective, final: levenberg_marquardt.Iterate, chamfer_before: float, noise_std: float
) -> tuple[str, dict[str, float]]:
    """Find out whether the fit is too far from the points to say anything.

    Args:
        full: objective of all frames.
        used: objective of the frames that were used.
        final: the solution.
        chamfer_before: distance of the start values [m].
        noise_std: of the points [m].

    Returns:
        Why it is, and the share of the misfit that each error of the recording would explain; empty where it is not.
    """
    misfit = _observation_entries(used, final).get("points_misfit")
    if misfit is None:
        return "", {}
    over_start = full.distance_metrics(final.raw).chamfer / chamfer_before if chamfer_before > 0 else 0.0
    reason = find_misfit(misfit, noise_std, over_start)
    if not reason:
        return "", {}
    reasons = rank_reasons(used, final)
    return f"{reason}; {describe_reasons(reasons)}", {r.name: r.share for r in reasons}


def _observed_frames(frames: Sequence[Tensor], full: Objective) -> list[Tensor]:
    """Frames without those after the last observation."""
    return [x[: e.observed_count] for x, e in zip(frames, full.episodes, strict=True)]


def _observed_forces(wrench: Mapping[str, Tensor], episode: Episode) -> dict[str, Tensor]:
    return {name: w[: episode.observed_count] for name, w in wrench.items()}


def _distance_entries(full: Objective, frames: Mapping[str, list[Tensor]]) -> dict[str, float]:
    metrics = {key: distance_metrics(x, full.episodes, full.faces) for key, x in frames.items()}
    return {f"{what}_{key}": getattr(m, what) for what in ("chamfer", "rms") for key, m in metrics.items()}


def _force_entries(full: Objective, start: list[Frames], end: list[Frames]) -> dict[str, float]:
    if not any(e.wrenches for e in full.episodes):
        return {}
    wrenches = {
        "before": [s.wrench for s in start],
        "after": [s.wrench for s in end],
        "null": [zero_forces(e) for e in full.episodes],
        "constant": [mean_forces(e) for e in full.episodes],
    }
    return {f"force_rms_{key}": force_rms(w, full.episodes) for key, w in wrenches.items()}


def _observation_entries(full: Objective, final: levenberg_marquardt.Iterate) -> dict[str, float]:
    """Effective number of observations, and the residuals' standard deviation for each kind of data."""
    entries, total, misfit = {}, 0.0, shared_misfit(full, final)
    for b, block in enumerate(full.blocks):
        residual = final.linear.residual[final.linear.blocks == b]
        residual = residual[residual != 0]
        if len(residual):
            entries[f"{block.name}_residual"] = float(final.scale[b])
            entries[f"{block.name}_misfit"] = float(misfit[b].sqrt())
            total += float(final.effective_fraction[b]) * len(residual)
    return {"effective_observations": total, **entries}
