"""``identify``: fit the parameters of a cloth to recordings."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, cast

import torch
from torch import Tensor

from .._utils.resume import Journal
from .._utils.torch_modes import own_gradients
from ..cloth import Cloth
from ..effects import AbstractEffect
from ..episodes.observed import Episode, episode, on_cpu
from ..episodes.replay import Frames
from ..episodes.unknowns import collect, with_priors
from ..errors import InvalidInput, SimulationDiverged, UnstableStep
from ..parameters import PhysicalParameter
from ..recordings import Recording
from .estimators import levenberg_marquardt
from .estimators.objective import Objective
from .estimators.search import CHAMFER, METHODS, Method, Outcome, Progress, Search
from .given import given
from .io.saved_fit import model_of
from .nuisances import chosen, foreseen, implied
from .residuals.blocks import blocks_for
from .residuals.metrics import figures, forces_rms
from .residuals.rigid_carry import constant_force, no_better_than, no_force, rigid_carry
from .result import Identification
from .uncertainty.consider_covariance import covariance_of
from .uncertainty.identifiability import combinations, influences
from .uncertainty.profile_likelihood import profiles
from .uncertainty.replicates import strata_of
from .uncertainty.reporting import estimates, nuisance_estimates, skewed, warnings_of, with_profiles, withdraw
from .uncertainty.richardson import LIMIT, OPEN, finer_cloth, mesh_step

PAPER_ITERATIONS = 35  # of the DiffCP paper's stop rule
MOST_STARTS = 1000
UNSURE = "the motion can be predicted for a while only, or by simulations spread around the solution"
ONLY_IN_CONTACT = ("contact_stiffness", "shear_stiffness", "cone")


@own_gradients()
def identify(
    cloth: Cloth,
    recordings: Recording | Sequence[Recording],
    parameters: Sequence[str] | None = None,
    *,
    method: Method = "gauss-newton",
    stop: Literal["converged", "paper"] = "converged",
    iterations: int = PAPER_ITERATIONS,
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
) -> Identification:
    """Fit scalar parameters of a cloth to what was seen and felt, by gradients through the simulation.

    Args:
        cloth: model and start values; left unchanged (see ``Identification.apply``).
        recordings: one or several episodes of the same cloth.
        parameters: public names, e.g. ["youngs_modulus", "air.normal"]; None: all material parameters that are not
            zero, and the first amplitude of each effect.
        method: "gauss-newton" (robust residuals, forward-mode sensitivities) or "lbfgs" (the same, reverse mode);
            "adam" or "gradient-descent" (the paper's Chamfer distance to vertices, reverse mode), for comparison: a
            distance knows of no errors, so these take neither priors nor nuisances, and the density as exact.
        stop: "converged", or "paper": as soon as the paper's Chamfer distance (one-sided, to vertices) is below 1.5 cm.
        iterations: at most this many with all frames, and at most 10 with the early ones before: the beginning of the
            same motion, so that neither velocity nor rest shape is ever set anew.
        rate: of "adam" and "gradient-descent": 0.1 is about 10 % a step, of an amplitude's typical size.
        guess: values by name to start the search from, e.g. of an interrupted fit; the cloth's values stay the start
            that the result is compared with.
        warm_start: the guess is near the solution (an interrupted fit): skip the stage on the early frames.
        dt: largest substep [s]; None: the stable one, chosen anew for every set of values.
        use: kinds of data, some of "points", "markers" and "force"; None: all that an episode has.
        nuisances: what may differ from episode to episode: "clock" [s], "camera" [m], "grasp" [m], "shape" [m], "tare"
            [N]; as names, or with the standard deviation of the prior, e.g. {"clock": 0.4}. "rim" [m], an offset of
            the cloud's rim, always joins where there are points, unless it is given as 0.
        priors: by parameter (value, factor) for positive ones: 68 % within that factor; (value, standard deviation)
            for others. Default: around the start, a factor of 10 for positive parameters, 1 in the logit of 2 nu, twice
            the typical size of amplitudes.
        noise: least standard deviation by kind of data: "points", "edges", "markers" [m], "force" [N], "torque" [N m].
        starts: how many, the given one and others over two decades of every positive parameter; each is followed on the
            early frames, and the best goes on. ``fit["starts_agreeing"]`` counts those that led to the same values.
        profile: names of fitted parameters whose interval is sought by holding them beside their estimate and fitting
            the others anew: it may be skew, and open. Some 20 simulations for each unknown of the fit.
        journal: folder in which the fit keeps what it computed; of no use any more once the result is safe.
        resume: go on where a fit with this journal was stopped; the result is what it would have been, bit by bit.
            None: start over, but refuse to where it could go on.
        refine: correct the result for the coarseness of the mesh, by one simulation on a mesh twice as fine, and widen
            its errors by what that leaves open (see ``finer.py``). ``fit["mesh_step"]`` has the largest correction in
            standard errors. Not where the motion is chaotic, and not together with ``profile``.
        on_progress: called with (iteration, chamfer, values, share of the frames that were used) after every iteration;
            chamfer is NaN if nothing was seen.

    Returns:
        Estimates with standard errors, distances, warnings, frames.

    Raises:
        InvalidInput: unknown names or options, or one episode twice.
        RecordingError: a recording without motion, with nothing seen or felt, or seen in another unit than metres.
        SimulationDiverged: the start values cannot be simulated.
    """
    _check(method, stop, iterations, starts)
    if not 0 < rate < math.inf:
        raise InvalidInput("rate", got=rate, expected="a number > 0")
    _check_priors(method, priors, nuisances, use)
    began = time.perf_counter()
    on_cpu(cloth)
    episodes_in = given(recordings)
    if refine and profile:
        raise InvalidInput("profile", got="refine as well", expected="one of them: a profile is that of the given mesh")
    if refine:
        finer_cloth(cloth)  # refuses now what it would refuse at the end
    asked = [parameters] if isinstance(parameters, str) else parameters
    names = default_parameters(cloth) if asked is None else list(asked)
    measured = None if method in CHAMFER else episodes_in[0].cloth.weighed  # joins as a prior only
    unknowns = with_priors(collect(cloth, names, measured), priors or {})
    if not unknowns:
        raise InvalidInput("parameters", got="none", expected="at least one name")
    _check_profile(profile, [u.name for u in unknowns])
    blocks = blocks_for(use)
    episodes = [episode(cloth, r) for r in episodes_in]
    _check_seen(method, stop, episodes)
    own = chosen(nuisances, implied([block.name for block in blocks], episodes))
    objective = Objective(cloth, unknowns, foreseen(episodes, own), dt, own, blocks, noise)
    start = objective.raw(guess or {})
    if journal is not None:
        objective.journal = Journal(journal, [method, stop, rate, starts, *objective.identity(), start], resume)
    search = Search(objective, stop, on_progress, strata_of(episodes_in))
    before = objective.seen(objective.start)
    outcome = search.run(method, start, iterations, rate, not warm_start and stop != "paper", starts)
    found = _concluded(search, before, outcome, began, profile, episodes_in if refine else [])
    return replace(found, model=model_of(cloth, found, episodes_in, dt))


def _check(method: str, stop: str, iterations: int, starts: int) -> None:
    if method not in METHODS or stop not in ("converged", "paper"):
        expected = f'{", ".join(map(repr, METHODS))}; "converged" or "paper"'
        raise InvalidInput("method or stop", got=f"{method!r}, {stop!r}", expected=expected)
    for name, number in (("iterations", iterations), ("starts", starts)):
        if not isinstance(number, int) or number < 1:
            raise InvalidInput(name, got=number, expected="at least 1, and whole")
    if starts > MOST_STARTS:
        raise InvalidInput("starts", got=starts, expected=f"at most {MOST_STARTS}")
    if starts > 1 and method in CHAMFER:
        raise InvalidInput(
            "starts",
            got=f"{starts} with method {method!r}",
            expected="1: several are compared by Gauss-Newton, with its priors, and not by the Chamfer distance alone",
            remedy='method "gauss-newton" or "lbfgs"',
        )


def _check_priors(
    method: str,
    priors: Mapping[str, Any] | None,
    nuisances: Mapping[str, Any] | Sequence[str],
    use: Sequence[str] | None,
) -> None:
    """Refuse what a mean distance cannot be weighed against: it has no noise, in whose units priors are.

    A search without them would go where they forbid, and report errors that have them in; nor does it choose among
    what was seen.
    """
    for name, asked in (("priors", priors), ("nuisances", nuisances), ("use", use)):
        if method in CHAMFER and asked:
            raise InvalidInput(
                name,
                got=f"{', '.join(asked)} with method {method!r}",
                expected="none: it follows the Chamfer distance alone",
                remedy='method "gauss-newton" or "lbfgs"',
            )


def _check_profile(names: Sequence[str], fitted: Sequence[str]) -> None:
    for name in names:
        if name not in fitted:
            raise InvalidInput("profile", got=repr(name), expected=f"some of {', '.join(fitted)}")


def _check_seen(method: str, stop: str, episodes: Sequence[Episode]) -> None:
    """Refuse what follows the Chamfer distance where nothing was seen."""
    for e in episodes:
        if (method in CHAMFER or stop == "paper") and not any(len(e.positions(t)) for t in range(len(e.times))):
            raise InvalidInput(
                f"{e.name}: method {method!r}, stop {stop!r}",
                got="an episode with neither points nor markers",
                expected="something seen, of which it takes the Chamfer distance",
                remedy='method "gauss-newton" or "lbfgs", stop "converged"',
            )


def default_parameters(cloth: Cloth) -> list[str]:
    """Membrane parameters, contact parameters if the model has contact, and each effect's main amplitude.

    Others (damping times, wind, curl) are fitted when they are named.
    """
    own = {name: part for name, part in cloth.material.named_modules() if isinstance(part, PhysicalParameter)}
    names = [name for name, part in own.items() if bool((part.value != 0).any())]
    if cloth.contact is None:
        names = [name for name in names if name not in ONLY_IN_CONTACT]
    for key, effect in cast("Iterable[tuple[str, AbstractEffect]]", cloth.effects.items()):
        main = next(iter(effect.amplitudes))
        part = getattr(effect, main)
        if isinstance(part, PhysicalParameter) and part.raw.ndim == 0:  # a residual force has one for each term
            names.append(f"{key}.{main}")
    return names


def _concluded(
    search: Search,
    start: list[Frames],
    outcome: Outcome,
    began: float,
    profile: Sequence[str],
    refining: Sequence[Recording],
) -> Identification:
    """From where a search ended to statements."""
    full, told, checked = search.objective, outcome.objective, outcome.checked
    final, warnings = checked.final, list(checked.warnings)
    covariance = covariance_of(told, checked, search.strata)
    regular = not checked.withdrawn and checked.covariance is None
    found = _refined(full, told, final, covariance, refining if regular else [])
    final, covariance, coarseness, uncorrected = found
    warnings += uncorrected
    end = full.seen(final.raw)
    before, after, null = [s.x for s in start], [s.x for s in end], [rigid_carry(e) for e in full.episodes]
    found = estimates(full.cloth, full.unknowns, final.raw, covariance)
    sure = not (checked.warnings or checked.withdrawn)
    profiled = profiles(told, final, covariance, profile, search.tell) if sure else {}
    warnings += [] if sure or not profile else [f"no profile of {', '.join(profile)}: {UNSURE}"]
    found = with_profiles(found, profiled)
    fit: dict[str, Any] = _figures(full, before, after, null)
    fit |= _force_figures(full, start, end)
    fit |= {
        "iterations": max(0, len(search.history) - 1),
        "simulations": search.simulations,
        "seconds": time.perf_counter() - began,
        "points": sum(len(c) for e in full.episodes for c in e.clouds),
        "stable_step": full.cloth.stable_step(),
        "converged": final.converged,
        **_counts(told, final),
        **coarseness,
    }
    if search.strata is not None and bool((search.strata > 0).any()):
        fit["replicates"] = int((search.strata > 0).sum())
    if outcome.reached is not None:
        fit |= {"starts": outcome.reached.tried, "starts_agreeing": outcome.reached.agree}
    null_of = no_better_than(full, end)
    withdrawn = checked.withdrawn or bool(null_of)
    if withdrawn:  # slopes of chaos, or of elsewhere, promise tiny errors
        found = withdraw(found, full.unknowns, final.raw)
    warnings += [outcome.unfinished] if outcome.unfinished else []
    warnings += skewed(found, [name for name in checked.curved if name not in profiled])
    used = [x[: len(e.times)] for x, e in zip(after, told.episodes, strict=True)]
    judged = {**fit, "rms_after": figures(used, told.episodes, full.faces).rms}
    if not full.uses("points", "markers"):  # what was seen beside is reported, and no verdict
        judged |= {"rms_after": math.nan, "chamfer_after": math.nan}
    warnings += warnings_of(full.cloth, full.episodes, found, judged, after, full.faces, null_of)
    keys = {u.name: u.key.removesuffix(".raw") for u in full.unknowns}
    nuisances = nuisance_estimates(full.episodes, full.placed, final.raw, covariance, withdrawn)
    return Identification(
        found.parameters,
        fit,
        found.correlation,
        warnings,
        search.history,
        _observed(before, full),
        _observed(after, full),
        _observed(null, full),
        keys,
        nuisances,
        influences(full.unknowns, final.raw, checked.reach, found.parameters),
        [] if withdrawn else combinations(full.unknowns, final.raw, covariance),
        profiles=profiled,
        forces_before=[_observed_forces(s.wrench, e) for s, e in zip(start, full.episodes, strict=True)],
        forces_after=[_observed_forces(s.wrench, e) for s, e in zip(end, full.episodes, strict=True)],
    )


def _refined(
    full: Objective,
    told: Objective,
    final: levenberg_marquardt.Iterate,
    covariance: Tensor,
    recordings: Sequence[Recording],
) -> tuple[levenberg_marquardt.Iterate, Tensor, dict[str, float], list[str]]:
    """The solution on a mesh of ever smaller triangles, with wider errors, how far that is; or why it is not known."""
    if not recordings or told is not full:
        return final, covariance, {}, []
    try:
        step = mesh_step(full, final, recordings)
        moved = final._replace(raw=full.clip(final.raw + LIMIT * step))
        full.seen(moved.raw)  # so that what cannot be simulated shows here; it is asked for again, and remembered
    except (SimulationDiverged, UnstableStep) as error:
        return final, covariance, {}, [f"not corrected for the coarseness of the mesh: on a finer one, {error}"]
    far = float((LIMIT * step.abs() / covariance.diagonal().sqrt())[: len(full.unknowns)].max())
    return moved, covariance + OPEN**2 * torch.outer(step, step), {"mesh_step": far}, []


def _observed(frames: Sequence[Tensor], full: Objective) -> list[Tensor]:
    """Without the frames after the last observation."""
    return [x[: e.observed] for x, e in zip(frames, full.episodes, strict=True)]


def _observed_forces(wrench: Mapping[str, Tensor], episode: Episode) -> dict[str, Tensor]:
    return {name: w[: episode.observed] for name, w in wrench.items()}


def _figures(full: Objective, *frames: list[Tensor]) -> dict[str, float]:
    now = {
        key: figures(x, full.episodes, full.faces) for key, x in zip(("before", "after", "null"), frames, strict=True)
    }
    return {f"{what}_{key}": getattr(f, what) for what in ("chamfer", "rms") for key, f in now.items()}


def _force_figures(full: Objective, start: list[Frames], end: list[Frames]) -> dict[str, float]:
    if not any(e.wrenches for e in full.episodes):
        return {}
    both = {"before": [s.wrench for s in start], "after": [s.wrench for s in end]}
    nulls = {"null": [no_force(e) for e in full.episodes], "constant": [constant_force(e) for e in full.episodes]}
    return {f"force_rms_{key}": forces_rms(wrenches, full.episodes) for key, wrenches in {**both, **nulls}.items()}


def _counts(full: Objective, final: levenberg_marquardt.Iterate) -> dict[str, float]:
    """Independent observations, and how far each kind of data is off."""
    out, total = {}, 0.0
    for b, block in enumerate(full.blocks):
        own = final.linear.value[final.linear.kind == b]
        own = own[own != 0]
        if len(own):
            out[f"{block.name}_residual"] = float(final.scale[b])
            total += float(final.share[b]) * len(own)
    return {"independent_observations": total, **out}
