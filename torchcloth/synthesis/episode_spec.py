"""What can be asked for."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from ..errors import InvalidInput
from ..materials.presets import find_fabric
from .garments import GARMENTS

MOTIONS = ("cover", "fling", "drag", "fold", "hang", "swing", "shake", "stretch")
CAMERAS = ("azure_kinect", "d435")
FEWEST, MOST = 50, 100_000  # triangles: fewer are no garment, more take days
FASTEST = {"rate": 1000.0, "speed": 100.0, "acceleration": 1000.0}


@dataclass(frozen=True)
class Order:
    """One episode.

    Attributes:
        garment: among ``GARMENTS``.
        motion: among ``MOTIONS``.
        fabric: a published fabric; None: the garment's own.
        seed: of the sensor's errors and of the place where the cloth lies (a few mm).
        triangles: of the cloth, about.
        camera: among ``CAMERAS``.
        arms: two Rizon 4 move the grippers, as their joints allow, and stand in the camera's way; else grippers fly.
        rate: frames per second.
        speed: m/s, of the grippers, at most.
        acceleration: m/s^2, likewise; with arms, the joints' limits lower both.

    Raises:
        InvalidInput: a name that is not known, or a number out of range.
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
        if not FEWEST <= self.triangles <= MOST:
            raise InvalidInput("triangles", got=self.triangles, expected=f"{FEWEST} to {MOST}")
        if self.seed < 0:
            raise InvalidInput("seed", got=self.seed, expected="0 or more")
        for name, most in FASTEST.items():
            if not 0 < getattr(self, name) <= most:
                raise InvalidInput(name, got=getattr(self, name), expected=f"a value > 0, at most {most:g}")

    @property
    def cloth_fabric(self) -> str:
        """The fabric that is used."""
        return GARMENTS[self.garment].fabric if self.fabric is None else self.fabric

    @property
    def name(self) -> str:
        """Of the episode's folder."""
        parts = [self.garment, self.motion, *([] if self.fabric is None else [self.fabric])]
        return "_".join([*parts, *([f"seed{self.seed}"] if self.seed else [])])

    def facts(self) -> dict[str, Any]:
        """As an episode stores it."""
        return asdict(self)
