"""Print what a hidden case holds, after the answer is written.

python -m torchcloth.training.validation.hidden.reveal_truth --seed 12
"""

from __future__ import annotations

import sys
from dataclasses import asdict
from typing import Any

from .case_command import print_case_json
from .case_sampling import CONFOUNDED_KINDS, Case, HiddenEffect
from .effect_map import OUTSIDE_EFFECTS, SINGLE_EFFECTS

EFFECT_MAP = SINGLE_EFFECTS | OUTSIDE_EFFECTS
# Causes that explain a confounded case as well as the hidden one, and whether the data may separate them after all.
CONFOUNDED_CAUSES = {
    # wind comes with drag, which damps
    "tilt or wind": {"causes": ["env.gravity_tilt", "air.wind", "obs.rotation"], "may_be_separable": True},
    "base or extrinsic": {"causes": ["obs.extrinsic", "robot.base"], "may_be_separable": False},
    "mass without forces": {"causes": ["mass.density"], "may_be_separable": False},
    "damping or drag": {"causes": ["air.linear", "air.drag_n"], "may_be_separable": True},
}


def reveal_truth(case: Case) -> dict[str, Any]:
    """Return what is hidden in a case, and the names that a diagnosis may give it."""
    enabling = {name for effect in case.effects for name, _ in EFFECT_MAP[effect.name].enabling_effects}
    effects = [
        {
            **asdict(effect),
            "amplitude": _library_amplitude(effect, case),
            "names": list(EFFECT_MAP[effect.name].names),
            "hypothesis": _hypothesis_name(effect),
            "sign": _axis_sign(effect.options.get("heading")) * EFFECT_MAP[effect.name].sign,
            "is_enabling": effect.name in enabling,
        }
        for effect in case.effects
    ]
    return {
        "seed": case.seed,
        "sealed": case.is_sealed,
        "family": case.family,
        "kind": case.kind,
        "effects": effects,
        "confounded": CONFOUNDED_CAUSES.get(case.kind) if case.kind in CONFOUNDED_KINDS else None,
        "fault": case.fault,
        "right_for_fault": ["obs.clock"] if case.fault == "clock jump" else [],
        "motions": [{"motion": e.motion, "heading": e.heading, "speed": e.speed} for e in case.episodes],
        "data_sheet_ratio": case.data_sheet_ratio,
        "fabric": case.fabric,
    }


def _library_amplitude(effect: HiddenEffect, case: Case) -> float:
    """Return the amplitude by the library's definition: a fraction of mass is one of the data sheet's."""
    if effect.name != "mass.density":
        return effect.amplitude
    return (1 + effect.amplitude) / case.data_sheet_ratio["areal_density"] - 1


def _hypothesis_name(effect: HiddenEffect) -> str:
    """Return the library's name with its axis, or "" where it has none."""
    mapping = EFFECT_MAP[effect.name]
    if not mapping.names:
        return ""
    axis = ("x" if effect.options["heading"] in (0.0, 180.0) else "y") if mapping.has_heading else mapping.axis
    return mapping.names[0] + (f"[{axis}]" if axis else "")


def _axis_sign(heading: float | None) -> float:
    """Return the sign along the world's axis that a heading [degrees] follows."""
    return 1.0 if heading in (None, 0.0, 90.0) else -1.0


if __name__ == "__main__":
    sys.exit(print_case_json(__doc__, reveal_truth))
