"""``torchcloth predict``: what a saved fit says of a specimen or an episode that it was not fitted to."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

from .._utils.files import as_json, write_text
from ..errors import InvalidInput
from .folders import check_apart, check_folder, place, replaces

RESULT = "prediction.json"
TABLE = "table.json"  # of a folder with readings of a tension machine
STRIP = ("angle", "length", "width", "preload", "strain")  # options that no episode has


def add(verbs: Any) -> None:
    """The verb and its options."""
    predict = verbs.add_parser(
        "predict",
        help="what a fit says of a direction or an episode that it was not fitted to",
        description="With a tension fit (tension.json): the curve of force and lateral strain of a strip cut at any "
        "angle, with its 95 % interval. With a fit of episodes (identification.json): where the cloth goes in another "
        "episode, how sure that is, and how far it is from what was seen.",
    )
    add = predict.add_argument
    add(
        "fit",
        type=Path,
        metavar="FIT",
        help="tension.json or identification.json, the folder that holds it, or a .tcm file of `diagnose`",
    )
    add("seen", type=Path, nargs="?", metavar="SEEN", help="a tension table or an episode: to predict and compare with")
    add("--out", type=place, metavar="DIR", help="folder for prediction.json and pictures (FIT's folder/prediction)")
    add("--angle", type=float, metavar="DEGREES", help="of the strip, from the warp")
    add("--length", type=float, metavar="M", help="of the strip (as fitted)")
    add("--width", type=float, metavar="M", help="of the cloth that carries the force (as fitted)")
    add("--preload", type=float, metavar="N", help="at displacement 0 (taut by the same strain as the fitted strips)")
    add("--strain", type=float, metavar="X", help="at the curve's end (the largest fitted near this angle)")
    predict.set_defaults(run=_predict)


def _predict(options: argparse.Namespace) -> int:
    import torch

    from ..identification.io.saved_fit import RESULT
    from ..identification.tension.model import RESULT as TENSION

    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    folder = options.fit if options.fit.is_dir() else options.fit.parent
    out = folder / "prediction" if options.out is None else options.out
    if options.seen is not None:
        check_apart(out, options.seen)
        if not options.seen.exists():
            raise InvalidInput("SEEN", got=options.seen, expected="a folder that exists")
    check_folder(out)
    given = any(getattr(options, name) is not None for name in STRIP)
    of_strip = given or (options.seen is not None and (options.seen / TABLE).is_file())
    if options.fit.suffix == ".tcm" and not of_strip:
        return _of_episode(options.fit, out, options)
    known = [name for name in (TENSION, RESULT) if (folder / name).is_file()]
    if not options.fit.is_dir():
        readable = options.fit.is_file() and (options.fit.suffix == ".tcm" or options.fit.name in known)
        known = [options.fit.name] if readable else []
    if not known:
        models = ", ".join(sorted(map(str, folder.glob("*.tcm"))))
        expected = f"{TENSION}, {RESULT} or the folder that holds it, or a .tcm file"
        remedy = f"name a model: {models}" if models else "correct the path"
        raise InvalidInput("FIT", got=options.fit, expected=expected, remedy=remedy)
    name = TENSION if of_strip or (options.seen is None and known == [TENSION]) else RESULT
    if name not in known:
        what = "a strip" if of_strip else "an episode"
        numbers = ", ".join(f"--{name}" for name in STRIP)
        fits = f"tables and {numbers} need a fit of tension tables" if of_strip else "episodes need a fit of episodes"
        raise InvalidInput("FIT", got=f"{known[0]} with {what} to predict", expected=name, remedy=fits)
    return (_of_strip if name == TENSION else _of_episode)(folder / name, out, options)


def _of_strip(fit: Path, out: Path, options: argparse.Namespace) -> int:
    from ..identification import pictures, predict_tension, prediction_report, read_model, specimen_like
    from ..recordings import read_tension

    model, given = read_model(fit), (options.length, options.width, options.preload, options.strain)
    if options.seen is not None:
        if options.angle is not None or any(number is not None for number in given):
            raise InvalidInput("SEEN", got="a table and a strip's numbers", expected="one of them")
        prediction = predict_tension(model, read_tension(options.seen))
    elif options.angle is None:
        raise InvalidInput("--angle", got="none", expected="degrees from the warp, or the folder of a table")
    else:
        size = dict(zip(("length", "width", "preload", "strain"), given, strict=True))
        prediction = predict_tension(model, *specimen_like(model, math.radians(options.angle), **size))
    note = replaces(out / RESULT)
    path = _write(out, prediction.as_dict())
    picture = pictures.save_figure(prediction_report.strip(prediction), out / "prediction.png")
    prediction_report.print_strip(prediction)
    print(f"result:   {path}{note}\npicture:  {picture}")
    return 0


def _of_episode(fit: Path, out: Path, options: argparse.Namespace) -> int:
    import numpy as np

    from .. import recordings
    from .._utils.files import atomically
    from ..diagnosis import predicted, start_of, was_fitted
    from ..identification import is_fitted, pictures, predict_episode, prediction_report

    if options.seen is None:
        raise InvalidInput("SEEN", got="none", expected="an episode whose motion is to be predicted")
    recording = recordings.read(options.seen)
    of_model = fit.suffix == ".tcm"
    found = predicted(fit, recording) if of_model else predict_episode(fit, recording, start_of(fit))
    note = replaces(out / RESULT)
    path = _write(out, found.as_dict())
    with atomically(out / "prediction.npz") as file:
        t, vertices, std = (part.numpy() for part in (found.episode.times, found.frames.x, found.std))
        interval, faces = found.interval.numpy(), found.cloth.mesh.faces
        np.savez_compressed(file, t=t, vertices=vertices, std=std, interval=interval, faces=faces)
    picture = pictures.save_figure(prediction_report.predicted(found), out / "prediction.png")
    prediction_report.print_predicted(found)
    if was_fitted(fit, recording) if of_model else is_fitted(fit, recording):
        print("note: this episode was fitted: its distances are residuals, not errors of a prediction")
    print(f"result:   {path}{note}\nframes:   {out / 'prediction.npz'}\npicture:  {picture}")
    return 0


def _write(out: Path, content: dict[str, Any]) -> Path:
    return write_text(out / RESULT, as_json(content))
