"""Configuration of a run as dataclasses, read from YAML with overrides; every key is checked.

The reader is our own because each error must be one line that says what, got, expected and remedy. jsonargparse
reports some errors over several lines, does not list the known keys, and does not accept ``key: value`` for a list.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from importlib import resources
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

from torchcloth.errors import InvalidInput

CHECKPOINT = "last.ckpt"  # in a run's folder


@dataclass(frozen=True)
class Data:
    """Episodes: folders, globs of folders, or ``example:NAME`` for a shipped one.

    Attributes:
        train: episodes to train with.
        val: episodes to validate with.
        val_motion: values of ``split.motion`` whose episodes are moved from ``train`` to ``val``.
        per_step: number of episodes in each optimiser step; 0: all.
    """

    train: list[str]
    val: list[str] = field(default_factory=list)
    val_motion: list[str] = field(default_factory=list)
    per_step: int = 0


@dataclass(frozen=True)
class Model:
    """Model of the cloth that the first episode describes.

    Attributes:
        start: start values by public name, in SI units.
        contact: spacing of the contact grid [m]; 0: no contact between layers.
        dt: largest substep [s]; 0: the stable one.
        precision: "float64" or "float32".
        engine: "auto", "reference" or "fused".
    """

    start: dict[str, float] = field(default_factory=dict)
    contact: float = 0.0
    dt: float = 0.0
    precision: str = "float64"
    engine: str = "auto"


@dataclass(frozen=True)
class Network:
    """A torch module that maps the place on the pattern to parameters.

    Attributes:
        module: "package.module.Class".
        outputs: names of the parameters, one for each column of the output.
        arguments: of the class.
    """

    module: str
    outputs: list[str]
    arguments: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Learn:
    """Parameters that are learned.

    Attributes:
        parameters: names of scalars.
        fields: names of fields with one value per triangle.
        network: that gives further parameters.
        roughness: weight of the mean squared difference of unconstrained values between adjacent triangles.
    """

    parameters: list[str] = field(default_factory=list)
    fields: list[str] = field(default_factory=list)
    network: Network | None = None
    roughness: float = 0.0


@dataclass(frozen=True)
class Optimizer:
    """Settings of Adam.

    Attributes:
        learning_rate: 0.1 is about 10 % of a positive parameter, or of a typical amplitude, in a step.
        steps: number of steps.
        half_life: number of steps after which the learning rate is halved; 0: constant.
    """

    learning_rate: float = 0.1
    steps: int = 50
    half_life: float = 0.0


@dataclass(frozen=True)
class Run:
    """Settings of the run.

    Attributes:
        processes: number on each node.
        nodes: number of nodes.
        seed: of networks and of the order of episodes.
        validate_every: number of steps between validations.
        loggers: "csv", "tensorboard" or both.
    """

    processes: int = 1
    nodes: int = 1
    seed: int = 0
    validate_every: int = 1
    loggers: list[str] = field(default_factory=lambda: ["csv"])


@dataclass(frozen=True)
class Config:
    """Configuration of a run.

    Attributes:
        out: folder for checkpoints and results.
        data: see ``Data``.
        learn: see ``Learn``.
        loss: scale of each loss by name, in the residual's unit; see ``Loss``.
        model: see ``Model``.
        optimizer: see ``Optimizer``.
        run: see ``Run``.
    """

    out: str
    data: Data
    learn: Learn
    loss: dict[str, float] = field(default_factory=lambda: {"points": 1e-3})
    model: Model = field(default_factory=Model)
    optimizer: Optimizer = field(default_factory=Optimizer)
    run: Run = field(default_factory=Run)

    @property
    def folder(self) -> Path:
        """Path of ``out`` with the user's home expanded."""
        return Path(self.out).expanduser()


ALLOWED_VALUES = {
    "model.precision": ("float64", "float32"),
    "model.engine": ("auto", "reference", "fused"),
    "run.loggers": ("csv", "tensorboard"),
}
LOWER_BOUNDS = {"data.per_step": 0, "model.contact": 0, "model.dt": 0, "learn.roughness": 0, "optimizer.half_life": 0}
LOWER_BOUNDS |= {"optimizer.steps": 1, "run.processes": 1, "run.nodes": 1, "run.validate_every": 1, "run.seed": 0}


def load(path: str, overrides: Sequence[str] = ()) -> Config:
    """Read a YAML file, or a shipped one by its name, and apply overrides ``section.key=value``.

    Raises:
        InvalidInput: the file does not exist or is not YAML, a key is unknown, or a value has the wrong type.
    """
    content = _mapping(path, _parse_yaml(path, _read_text(path)))
    for pair in overrides:
        key, equals, value = pair.partition("=")
        if not equals or not key:
            raise InvalidInput("override", got=repr(pair), expected="KEY=VALUE, e.g. optimizer.steps=10")
        _override(content, key, _parse_yaml(key, value))
    return from_dict(content)


def from_dict(content: Mapping[str, Any]) -> Config:
    """Build a configuration from nested dicts and check it.

    Raises:
        InvalidInput: a key is unknown, or a value has the wrong type.
    """
    config = _build(Config, content, "")
    try:
        config.folder  # noqa: B018 - fails if ``~user`` is unknown
    except RuntimeError as error:
        raise InvalidInput("config: out", got=f"{config.out} ({error})", expected="a folder") from None
    for key, legal in {**ALLOWED_VALUES, **LOWER_BOUNDS}.items():
        section, _, name = key.partition(".")
        value = getattr(getattr(config, section), name)
        if isinstance(legal, tuple):
            bad_values = [v for v in (value if isinstance(value, list) else [value]) if v not in legal]
            if bad_values:
                raise InvalidInput(f"config: {key}", got=repr(bad_values[0]), expected=" or ".join(legal))
        elif not (value >= legal and math.isfinite(value)):
            raise InvalidInput(f"config: {key}", got=value, expected=f"at least {legal}, and finite")
    if config.run.seed >= 2**32:
        raise InvalidInput("config: run.seed", got=config.run.seed, expected="below 2^32")
    if not 0 < (rate := config.optimizer.learning_rate) < math.inf:
        raise InvalidInput("config: optimizer.learning_rate", got=rate, expected="more than 0, and finite")
    return config


def _read_text(path: str) -> str:
    shipped = resources.files("torchcloth.training") / "configs"
    file = Path(path)
    if not file.is_file() and (shipped / f"{path}.yaml").is_file():
        return (shipped / f"{path}.yaml").read_text()
    try:
        return file.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        names = sorted(entry.name.removesuffix(".yaml") for entry in shipped.iterdir())
        expected = f"a YAML file, or a shipped one: {', '.join(names)}"
        raise InvalidInput("--config", got=f"{path} ({type(error).__name__})", expected=expected) from None


def _parse_yaml(what: str, text: str) -> Any:
    import yaml

    class Loader(yaml.SafeLoader):
        """Loader that refuses a key that is given twice, because one of the values would be ignored."""

        def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
            plain_keys = (key for key, _ in node.value if key.tag != "tag:yaml.org,2002:merge")
            keys = [self.construct_object(key, deep=True) for key in plain_keys]
            for k, key in enumerate(keys):
                if key in keys[:k]:
                    raise ValueError(f"{key!r} twice{node.start_mark}")
            return super().construct_mapping(node, deep)

    try:
        return yaml.load(text, Loader)
    except (yaml.YAMLError, ValueError) as error:  # ValueError: e.g. an impossible date
        raise InvalidInput(what, got=str(error), expected="YAML") from None


def _override(content: dict[str, Any], key: str, value: Any) -> None:
    """Set a value in nested dicts; below sections, names may contain dots (``model.start.air.normal``)."""
    section, rest = key.split(".")[0], key
    kind: Any = Config
    while "." in rest and is_dataclass(kind):
        section, rest = rest.split(".", 1)
        kind = _dataclass_of(get_type_hints(kind).get(section))
        subsection = content.get(section) or {}
        is_leaf = kind is not None and not is_dataclass(kind) and get_origin(kind) is not dict
        if is_leaf or not isinstance(subsection, dict):
            raise InvalidInput("override", got=key, expected=f"nothing inside of {section!r}, which has no keys")
        content[section] = subsection = dict(subsection)
        content = subsection
    content[rest] = value


def _dataclass_of(kind: Any) -> Any:
    """Return the dataclass in ``kind | None``."""
    return next((k for k in get_args(kind) if is_dataclass(k)), kind)


def _mapping(where: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        raise InvalidInput(f"config: {where}", got=repr(value), expected="keys with values")
    return value


def _build(kind: Any, content: Any, where: str) -> Any:
    content = _mapping(where or "file", content)
    kinds = get_type_hints(kind)
    for key in content:
        if key not in kinds:
            raise InvalidInput(f"config: {where}{key}", got="an unknown key", expected=f"one of {', '.join(kinds)}")
    for f in fields(kind):
        if f.default is MISSING and f.default_factory is MISSING and f.name not in content:
            raise InvalidInput(f"config: {where}{f.name}", got="nothing", expected="a value")
    return kind(**{key: _value(kinds[key], value, where + key) for key, value in content.items()})


def _value(kind: Any, value: Any, where: str) -> Any:
    if is_dataclass(_dataclass_of(kind)):
        return (
            None
            if value is None and kind is not _dataclass_of(kind)
            else _build(_dataclass_of(kind), value, where + ".")
        )
    origin, subsection = get_origin(kind), get_args(kind)
    if origin is dict:
        return {key: _value(subsection[1], item, f"{where}.{key}") for key, item in _mapping(where, value).items()}
    if origin is list:
        return [_value(subsection[0], item, where) for item in (value if isinstance(value, list) else [value])]
    return _scalar(kind, value, where)


def _scalar(kind: Any, value: Any, where: str) -> Any:
    """Check a scalar; numbers such as 5e4, which YAML 1.1 reads as text, are converted."""
    if kind is Any or (kind in (int, str) and type(value) is kind):
        return value
    try:
        if kind is float and type(value) in (int, float, str):
            return float(value)
    except (ValueError, OverflowError):
        pass
    name = {"int": "a whole number", "float": "a number", "str": "text"}[kind.__name__]
    raise InvalidInput(f"config: {where}", got=repr(value), expected=name)
