"""Says what a hidden case holds, after the answer is written.

python -m torchcloth.training.validation.hidden.reveal_truth --seed 12
"""

from __future__ import annotations

import sys
from dataclasses import asdict

from .case_command import told
from .case_sampling import CONFOUNDED, Case, Hidden
from .effect_map import OUTSIDE, SINGLES

LIKE = {  # confounded cases: what else explains the data as well; what one may tell apart after all is "soft"
    "tilt or wind": {"like": ["env.gravity_tilt", "air.wind", "obs.rotation"], "soft": True},  # wind brings drag
    "base or extrinsic": {"like": ["obs.extrinsic", "robot.base"], "soft": False},
    "mass without forces": {"like": ["mass.density"], "soft": False},
    "damping or drag": {"like": ["air.linear", "air.drag_n"], "soft": True},
}


def truth(found: Case) -> dict[str, object]:
    """What is hidden, and what a diagnosis may call it."""
    needed = {n for h in found.effects for n, _ in _partner(h.name).beside}
    effects = [
        {
            **asdict(h),
            "amplitude": _by_sheet(h, found),
            "names": list(_partner(h.name).names),
            "hypothesis": _hypothesis(h),
            "sign": _forward(h.options.get("heading")) * _partner(h.name).sign,
            "beside": h.name in needed,
        }
        for h in found.effects
    ]
    return {
        "seed": found.seed,
        "sealed": found.sealed,
        "family": found.family,
        "kind": found.kind,
        "effects": effects,
        "confounded": LIKE.get(found.kind) if found.kind in CONFOUNDED else None,
        "fault": found.fault,
        "right_for_fault": ["obs.clock"] if found.fault == "clock jump" else [],
        "motions": [{"motion": t.motion, "heading": t.heading, "speed": t.speed} for t in found.takes],
        "said": found.said,
        "fabric": found.fabric,
    }


def _by_sheet(hidden: Hidden, found: Case) -> float:
    """The amplitude as the library means it: a share of mass is one of what the data sheet says."""
    if hidden.name != "mass.density":
        return hidden.amplitude
    return (1 + hidden.amplitude) / found.said["areal_density"] - 1


def _partner(name: str):
    return (SINGLES | OUTSIDE)[name]


def _hypothesis(hidden: Hidden) -> str:
    """The library's name with its axis; "" where it has none."""
    own = _partner(hidden.name)
    axis = ("x" if hidden.options["heading"] in (0.0, 180.0) else "y") if own.headed else own.axis
    return own.names[0] + (f"[{axis}]" if axis else "") if own.names else ""


def _forward(heading: float | None) -> float:
    """Sign along the world's axis that a heading follows."""
    return 1.0 if heading in (None, 0.0, 90.0) else -1.0


if __name__ == "__main__":
    sys.exit(told(__doc__, truth))
