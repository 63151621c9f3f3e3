"""What a run is made of, as dataclasses; read from YAML with overrides, every key checked."""

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
    """Episodes: folders, globs of folders, or ``example:NAME`` for one that is shipped."""

    train: list[str]
    val: list[str] = field(default_factory=list)
    val_motion: list[str] = field(default_factory=list)  # held out of ``train``: episodes of these ``split.motion``
    per_step: int = 0  # episodes at every optimiser step; 0: all


@dataclass(frozen=True)
class Model:
    """The cloth that the first episode describes."""

    start: dict[str, float] = field(default_factory=dict)  # values by public name, SI units
    contact: float = 0.0  # m, spacing of the contact grid; 0: no contact between layers
    dt: float = 0.0  # s, largest substep; 0: the stable one
    precision: str = "float64"
    engine: str = "auto"


@dataclass(frozen=True)
class Network:
    """A torch module that gives parameters from the place on the pattern."""

    module: str  # "package.module.Class"
    gives: list[str]  # parameters that it gives, one column each
    arguments: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Learn:
    """What is learned."""

    parameters: list[str] = field(default_factory=list)  # one number each
    fields: list[str] = field(default_factory=list)  # one number for each triangle
    network: Network | None = None
    roughness: float = 0.0  # price of a unit of mean squared difference between neighbouring triangles, unconstrained


@dataclass(frozen=True)
class Optimizer:
    """Adam."""

    rate: float = 0.1  # of a step: about 10 % of a positive parameter, of a typical amplitude
    steps: int = 50
    half_life: float = 0.0  # steps after which the rate is half; 0: constant


@dataclass(frozen=True)
class Run:
    """Processes, loggers, seed."""

    processes: int = 1  # on each node
    nodes: int = 1
    seed: int = 0
    validate_every: int = 1  # steps
    loggers: list[str] = field(default_factory=lambda: ["csv"])


@dataclass(frozen=True)
class Config:
    """One run."""

    out: str
    data: Data
    learn: Learn
    loss: dict[str, float] = field(default_factory=lambda: {"points": 1e-3})  # by name, what counts as 1 in its unit
    model: Model = field(default_factory=Model)
    optimizer: Optimizer = field(default_factory=Optimizer)
    run: Run = field(default_factory=Run)

    @property
    def folder(self) -> Path:
        """``out``, which may be in somebody's home."""
        return Path(self.out).expanduser()


CHOICES = {
    "model.precision": ("float64", "float32"),
    "model.engine": ("auto", "reference", "fused"),
    "run.loggers": ("csv", "tensorboard"),
}
AT_LEAST = {"data.per_step": 0, "model.contact": 0, "model.dt": 0, "learn.roughness": 0, "optimizer.half_life": 0}
AT_LEAST |= {"optimizer.steps": 1, "run.processes": 1, "run.nodes": 1, "run.validate_every": 1, "run.seed": 0}


def load(path: str, overrides: Sequence[str] = ()) -> Config:
    """A YAML file, or the name of a shipped one, with ``key.of.it=value`` replaced.

    Raises:
        InvalidInput: no such file, not YAML, an unknown key, a value of the wrong kind.
    """
    content = _mapping(path, _parsed(path, _text(path)))
    for pair in overrides:
        key, equals, value = pair.partition("=")
        if not equals or not key:
            raise InvalidInput("override", got=repr(pair), expected="KEY=VALUE, e.g. optimizer.steps=10")
        _put(content, key, _parsed(key, value))
    return from_dict(content)


def from_dict(content: Mapping[str, Any]) -> Config:
    """Nested dicts, checked.

    Raises:
        InvalidInput: an unknown key, a value of the wrong kind.
    """
    config = _build(Config, content, "")
    try:
        config.folder  # noqa: B018 - of a user whom this machine has
    except RuntimeError as error:
        raise InvalidInput("config: out", got=f"{config.out} ({error})", expected="a folder") from None
    for key, legal in {**CHOICES, **AT_LEAST}.items():
        section, _, name = key.partition(".")
        value = getattr(getattr(config, section), name)
        if isinstance(legal, tuple):
            wrong = [v for v in (value if isinstance(value, list) else [value]) if v not in legal]
            if wrong:
                raise InvalidInput(f"config: {key}", got=repr(wrong[0]), expected=" or ".join(legal))
        elif not (value >= legal and math.isfinite(value)):
            raise InvalidInput(f"config: {key}", got=value, expected=f"at least {legal}, and finite")
    if config.run.seed >= 2**32:
        raise InvalidInput("config: run.seed", got=config.run.seed, expected="below 2^32")
    if not 0 < config.optimizer.rate < math.inf:
        raise InvalidInput("config: optimizer.rate", got=config.optimizer.rate, expected="more than 0, and finite")
    return config


def _text(path: str) -> str:
    shipped = resources.files("torchcloth.training") / "configs"
    file = Path(path)
    if not file.is_file() and (shipped / f"{path}.yaml").is_file():
        return (shipped / f"{path}.yaml").read_text()
    try:
        return file.read_text()
    except (OSError, UnicodeDecodeError) as error:
        names = sorted(entry.name.removesuffix(".yaml") for entry in shipped.iterdir())
        expected = f"a YAML file, or a shipped one: {', '.join(names)}"
        raise InvalidInput("--config", got=f"{path} ({type(error).__name__})", expected=expected) from None


def _parsed(what: str, text: str) -> Any:
    import yaml

    class Loader(yaml.SafeLoader):
        """Of a key that stands there twice, one would be ignored."""

        def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
            own = (key for key, _ in node.value if key.tag != "tag:yaml.org,2002:merge")
            keys = [self.construct_object(key, deep=True) for key in own]
            for k, key in enumerate(keys):
                if key in keys[:k]:
                    raise ValueError(f"{key!r} twice{node.start_mark}")
            return super().construct_mapping(node, deep)

    try:
        return yaml.load(text, Loader)
    except (yaml.YAMLError, ValueError) as error:  # a day that no month has
        raise InvalidInput(what, got=str(error), expected="YAML") from None


def _put(content: dict[str, Any], key: str, value: Any) -> None:
    """Into nested dicts; names with dots (``model.start.air.normal``) are keys of what has no sections."""
    section, rest = key.split(".")[0], key
    kind: Any = Config
    while "." in rest and is_dataclass(kind):
        section, rest = rest.split(".", 1)
        kind = _section(get_type_hints(kind).get(section))
        inner = content.get(section) or {}
        plain = kind is not None and not is_dataclass(kind) and get_origin(kind) is not dict
        if plain or not isinstance(inner, dict):
            raise InvalidInput("override", got=key, expected=f"nothing inside of {section!r}, which has no keys")
        content[section] = inner = dict(inner)
        content = inner
    content[rest] = value


def _section(kind: Any) -> Any:
    """The dataclass in ``kind | None``."""
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
    if is_dataclass(_section(kind)):
        return None if value is None and kind is not _section(kind) else _build(_section(kind), value, where + ".")
    origin, inner = get_origin(kind), get_args(kind)
    if origin is dict:
        return {key: _value(inner[1], item, f"{where}.{key}") for key, item in _mapping(where, value).items()}
    if origin is list:
        return [_value(inner[0], item, where) for item in (value if isinstance(value, list) else [value])]
    return _scalar(kind, value, where)


def _scalar(kind: Any, value: Any, where: str) -> Any:
    """YAML 1.1 reads 5e4 as text."""
    if kind is Any or (kind in (int, str) and type(value) is kind):
        return value
    try:
        if kind is float and type(value) in (int, float, str):
            return float(value)
    except (ValueError, OverflowError):
        pass
    name = {"int": "a whole number", "float": "a number", "str": "text"}[kind.__name__]
    raise InvalidInput(f"config: {where}", got=repr(value), expected=name)
