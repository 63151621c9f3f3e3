"""``torchcloth predict``: predict a tension specimen or an episode with a saved fit."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

from .._utils.files import save_figure, to_json, write_text
from ..errors import InvalidInput
from .output_paths import check_output_folder, check_outside_episodes, output_path, replacement_note

PREDICTION_FILE_NAME = "prediction.json"
TENSION_TABLE_FILE = "table.json"  # in a folder with readings of a tension machine
STRIP_OPTIONS = ("angle", "length", "width", "preload", "strain")  # not for episodes


def add(verbs: Any) -> None:
    """Add the verb and its options."""
    predict = verbs.add_parser(
        "predict",
        help="predict a strip at another angle, or another episode, with a saved fit",
        description="A tension fit (tension.json) predicts force and lateral strain of a strip that is cut at any "
        "angle. A fit of episodes (identification.json) predicts the cloth's motion in another episode and compares it "
        "with the observations. Both come with 95 % intervals.",
    )
    add = predict.add_argument
    add(
        "fit",
        type=Path,
        metavar="FIT",
        help="tension.json or identification.json, the folder that holds it, or a .tcm file of `diagnose`",
    )
    add("data", type=Path, nargs="?", metavar="DATA", help="tension table or episode to predict and to compare with")
    add(
        "--out",
        type=output_path,
        metavar="DIR",
        help="folder for prediction.json and pictures (default: prediction/ beside FIT)",
    )
    add("--angle", type=float, metavar="DEGREES", help="angle of the strip from the warp")
    add("--length", type=float, metavar="M", help="length of the strip [m] (default: as fitted)")
    add("--width", type=float, metavar="M", help="width that carries the force [m] (default: as fitted)")
    add(
        "--preload",
        type=float,
        metavar="N",
        help="force at displacement 0 [N] (default: that of the fitted strips' strain)",
    )
    add(
        "--strain",
        type=float,
        metavar="X",
        help="strain at the end of the curve (default: the largest that was fitted near this angle)",
    )
    predict.set_defaults(run=_predict)


def _predict(options: argparse.Namespace) -> int:
    import torch

    from ..identification.result import IDENTIFICATION_FILE_NAME
    from ..identification.tension.model import TENSION_FILE_NAME

    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    folder = options.fit if options.fit.is_dir() else options.fit.parent
    out = folder / "prediction" if options.out is None else options.out
    if options.data is not None:
        check_outside_episodes(out, options.data)
        if not options.data.exists():
            raise InvalidInput("DATA", got=options.data, expected="a folder that exists")
    check_output_folder(out)
    strip_values = any(getattr(options, name) is not None for name in STRIP_OPTIONS)
    is_strip = strip_values or (options.data is not None and (options.data / TENSION_TABLE_FILE).is_file())
    if options.fit.suffix == ".tcm" and not is_strip:
        return _predict_episode(options.fit, out, options)
    available = [name for name in (TENSION_FILE_NAME, IDENTIFICATION_FILE_NAME) if (folder / name).is_file()]
    if not options.fit.is_dir():
        readable = options.fit.is_file() and (options.fit.suffix == ".tcm" or options.fit.name in available)
        available = [options.fit.name] if readable else []
    if not available:
        models = ", ".join(sorted(map(str, folder.glob("*.tcm"))))
        expected = f"{TENSION_FILE_NAME}, {IDENTIFICATION_FILE_NAME} or the folder that holds it, or a .tcm file"
        remedy = f"name a model: {models}" if models else "correct the path"
        raise InvalidInput("FIT", got=options.fit, expected=expected, remedy=remedy)
    name = (
        TENSION_FILE_NAME
        if is_strip or (options.data is None and available == [TENSION_FILE_NAME])
        else IDENTIFICATION_FILE_NAME
    )
    if name not in available:
        kind = "a strip" if is_strip else "an episode"
        numbers = ", ".join(f"--{name}" for name in STRIP_OPTIONS)
        needed = f"tables and {numbers} need a fit of tension tables" if is_strip else "episodes need a fit of episodes"
        raise InvalidInput("FIT", got=f"{available[0]} with {kind} to predict", expected=name, remedy=needed)
    return (_predict_strip if name == TENSION_FILE_NAME else _predict_episode)(folder / name, out, options)


def _predict_strip(fit: Path, out: Path, options: argparse.Namespace) -> int:
    from ..identification import make_specimen, predict_tension, prediction_report, read_tension_model
    from ..recordings import read_tension

    model, strip_values = read_tension_model(fit), (options.length, options.width, options.preload, options.strain)
    if options.data is not None:
        if options.angle is not None or any(number is not None for number in strip_values):
            raise InvalidInput("DATA", got="a table and a strip's numbers", expected="one of them")
        prediction = predict_tension(model, read_tension(options.data))
    elif options.angle is None:
        raise InvalidInput("--angle", got="none", expected="degrees from the warp, or the folder of a table")
    else:
        size = dict(zip(("length", "width", "preload", "strain"), strip_values, strict=True))
        prediction = predict_tension(model, *make_specimen(model, math.radians(options.angle), **size))
    note = replacement_note(out / PREDICTION_FILE_NAME)
    path = _write(out, prediction.as_dict())
    picture = save_figure(prediction_report.plot_tension_prediction(prediction), out / "prediction.png")
    prediction_report.print_tension_prediction(prediction)
    print(f"result:   {path}{note}\npicture:  {picture}")
    return 0


def _predict_episode(fit: Path, out: Path, options: argparse.Namespace) -> int:
    import numpy as np

    from .. import diagnosis, recordings
    from .._utils.files import write_atomically
    from ..identification import is_fitted_episode, predict_episode, prediction_report

    if options.data is None:
        raise InvalidInput("DATA", got="none", expected="an episode whose motion is to be predicted")
    recording = recordings.read(options.data)
    is_model = fit.suffix == ".tcm"
    if is_model:
        prediction = diagnosis.predict_episode(fit, recording)
    else:
        prediction = predict_episode(fit, recording, diagnosis.make_start_builder(fit))
    note = replacement_note(out / PREDICTION_FILE_NAME)
    path = _write(out, prediction.as_dict())
    with write_atomically(out / "prediction.npz") as file:
        t, vertices, std = (
            part.numpy() for part in (prediction.episode.times, prediction.frames.x, prediction.vertex_std)
        )
        interval, faces = prediction.half_width.numpy(), prediction.cloth.mesh.faces
        np.savez_compressed(file, t=t, vertices=vertices, std=std, interval=interval, faces=faces)
    picture = save_figure(prediction_report.plot_episode_prediction(prediction), out / "prediction.png")
    prediction_report.print_episode_prediction(prediction)
    if diagnosis.was_fitted(fit, recording) if is_model else is_fitted_episode(fit, recording):
        print("note: the fit used this episode, so its distances are residuals and not prediction errors")
    print(f"result:   {path}{note}\nframes:   {out / 'prediction.npz'}\npicture:  {picture}")
    return 0


def _write(out: Path, content: dict[str, Any]) -> Path:
    return write_text(out / PREDICTION_FILE_NAME, to_json(content))
