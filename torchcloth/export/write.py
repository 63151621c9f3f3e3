"""Write a cloth or a saved fit for another engine."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from .. import diagnosis
from .._utils.files import write_text
from ..cloth import Cloth
from ..episodes.recorded_cloth import compute_initial_vertices
from ..errors import InvalidInput
from ..identification import load_fitted_cloth
from ..identification.io.saved_fit import read_saved_fit
from ..recordings import Recording
from .mujoco import export_mujoco
from .newton import export_newton
from .report import Export
from .sheet import Sheet, describe_sheet
from .usd import export_usd

MODEL_SUFFIX = ".tcm"
SUFFIXES = {"mujoco": (".xml",), "newton": (".json",), "usd": (".usda", ".usd")}
WRITERS: Mapping[str, Callable[[Sheet], Export]] = {
    "mujoco": export_mujoco,
    "newton": export_newton,
    "usd": export_usd,
}


def export_cloth(
    cloth: Cloth, target: str, path: str | Path | None = None, *, initial: np.ndarray | None = None
) -> Export:
    """Describe a cloth in the units and parameters of another engine.

    Args:
        cloth: any cloth.
        target: "mujoco" (MJCF), "newton" (JSON) or "usd" (.usda).
        path: file to write; None: none.
        initial: [V, 3] m, positions of the vertices to start from; None: those of the mesh.

    Returns:
        The file's text, the parameters in it, and what the target does not express.

    Raises:
        InvalidInput: no such target, a batch of cloths, or initial vertices of another mesh.
    """
    return _write(describe_sheet(cloth, initial), target, path)


def export_fit(
    fit: str | Path, target: str, path: str | Path | None = None, *, recording: Recording | None = None
) -> Export:
    """Export a saved fit.

    Args:
        fit: identification.json, the folder that holds it, or a ``.tcm`` file of ``diagnose``.
        target: as for ``export_cloth``.
        path: file to write; None: none.
        recording: an episode of the cloth, which has the mesh and where it starts. A ``.tcm`` file needs none.

    Raises:
        InvalidInput: no such file or target, or a fit of episodes without one.
        RecordingError: the file cannot be read, or the episode is of another cloth.
    """
    fit, initial, unidentified = Path(fit), None, ()
    _check_target(target, path)
    if fit.suffix == MODEL_SUFFIX:
        cloth = diagnosis.load(fit) if recording is None else diagnosis.load_cloth_for(fit, recording)
    elif recording is None:
        read_saved_fit(fit)  # first of all it must be a fit
        raise InvalidInput(
            "EPISODE", got="none", expected="an episode that the fit used: identification.json has no mesh"
        )
    else:
        cloth, _ = load_fitted_cloth(fit, recording, diagnosis.make_start_builder(fit))
        unidentified = read_saved_fit(fit).unidentified
    if recording is not None:
        initial = compute_initial_vertices(str(recording.path), cloth, recording).numpy()
    sheet = describe_sheet(cloth, initial)
    if unidentified:
        names = ", ".join(unidentified)
        note = f"no estimate of {names}: the data of the fit do not tell, and numbers that depend on these are guesses"
        sheet = replace(sheet, notes=(note, *sheet.notes))
    if fit.suffix == MODEL_SUFFIX:
        outside = diagnosis.list_causes_outside_cloth(diagnosis.load_model(fit))
        added = [f"cause {name} ({value:.3g}) is of the robot or the observer" for name, value in outside.items()]
        sheet = replace(sheet, notes=(*sheet.notes, *added))
    return _write(sheet, target, path)


def _check_target(target: str, path: str | Path | None) -> None:
    if target not in WRITERS:
        raise InvalidInput("target", got=repr(target), expected=" or ".join(WRITERS))
    if path is not None and Path(path).suffix not in SUFFIXES[target]:
        raise InvalidInput(
            "file", got=path, expected=f"a name that ends in {' or '.join(SUFFIXES[target])} for {target}"
        )


def _write(sheet: Sheet, target: str, path: str | Path | None) -> Export:
    _check_target(target, path)
    export = WRITERS[target](sheet)
    if path is not None:
        write_text(Path(path), export.text)
    return export
