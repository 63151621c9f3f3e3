"""Specification of a synthetic episode."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from ..errors import InvalidInput
from ..materials.presets import find_fabric
from .garments import GARMENTS

MOTIONS = ("cover", "fling", "drag", "fold", "hang", "swing", "shake", "stretch")
CAMERAS = ("azure_kinect", "d435")
MIN_TRIANGLES, MAX_TRIANGLES = 50, 100_000  # fewer cannot form a garment, more take days
UPPER_LIMITS = {"rate": 1000.0, "speed": 100.0, "acceleration": 1000.0}  # Hz, m/s, m/s^2


@dataclass(frozen=True)
class EpisodeSpec:
    """Specification of one episode.

    Attributes:
        garment: one of ``GARMENTS``.
        motion: one of ``MOTIONS``.
        fabric: a published fabric; None: that of the garment.
        seed: of the sensor's errors and of the cloth's placement (a few mm).
        triangles: approximate number of triangles of the cloth.
        camera: one of ``CAMERAS``.
        arms: whether two Rizon 4 arms move the grippers, within their joint limits, and occlude the camera's view;
            otherwise grippers are free.
        rate: frames per second.
        speed: largest speed of the grippers [m/s].
        acceleration: largest acceleration of the grippers [m/s^2]; with arms, joint limits lower both.

    Raises:
        InvalidInput: a name is unknown, or a number is out of range.
    """

    garment: str
    motion: str
    fabric: str | None = None
    seed: int = 0
    triangles: int = 800
    camera: str = "azure_kinect"
    arms: bool = True
    rate: float = 15.0
    speed: float = 1.0
    acceleration: float = 5.0

    def __post_init__(self) -> None:
        for name, known in (("garment", tuple(GARMENTS)), ("motion", MOTIONS), ("camera", CAMERAS)):
            if getattr(self, name) not in known:
                raise InvalidInput(name, got=repr(getattr(self, name)), expected=f"one of {', '.join(known)}")
        find_fabric(self.cloth_fabric)
        if not MIN_TRIANGLES <= self.triangles <= MAX_TRIANGLES:
            raise InvalidInput("triangles", got=self.triangles, expected=f"{MIN_TRIANGLES} to {MAX_TRIANGLES}")
        if self.seed < 0:
            raise InvalidInput("seed", got=self.seed, expected="0 or more")
        for name, limit in UPPER_LIMITS.items():
            if not 0 < getattr(self, name) <= limit:
                raise InvalidInput(name, got=getattr(self, name), expected=f"a value > 0, at most {limit:g}")

    @property
    def cloth_fabric(self) -> str:
        """Name of the fabric that is used."""
        return GARMENTS[self.garment].fabric if self.fabric is None else self.fabric

    @property
    def name(self) -> str:
        """Name of the episode's folder."""
        parts = [self.garment, self.motion, *([] if self.fabric is None else [self.fabric])]
        return "_".join([*parts, *([f"seed{self.seed}"] if self.seed else [])])

    def as_dict(self) -> dict[str, Any]:
        """Return the specification as the episode stores it."""
        return asdict(self)
