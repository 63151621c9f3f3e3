"""``torchcloth doctor``: what is installed and what works."""

from __future__ import annotations

import argparse
from importlib import metadata
from typing import Any

PACKAGES = {
    "pytorch_kinematics": "robots",
    "yourdfpy": "robots",
    "trimesh": "robots",
    "open3d": "observe",
    "rosbags": "data",
    "pyarrow": "data",
    "av": "data",
    "viser": "viz",
    "rerun": "viz",
    "lightning": "training",
    "gymnasium": "rl",
    "stable_baselines3": "rl",
}


def add(verbs: Any) -> None:
    """The verb."""
    doctor = verbs.add_parser("doctor", help="say what is installed and what works")
    doctor.set_defaults(run=_doctor)


def _doctor(options: argparse.Namespace) -> int:
    from importlib.util import find_spec

    import torch

    from ..engine import library
    from ..engine.cuda import driver

    print(f"torchcloth {metadata.version('torchcloth')}, torch {torch.__version__}, CUDA {torch.cuda.is_available()}")
    print(f"{'engine':20s} {library.status()}")
    if torch.cuda.is_available():
        print(f"{'engine on CUDA':20s} {driver.status()}")
    for name, extra in PACKAGES.items():
        state = "installed" if find_spec(name) else f'missing: pip install "torchcloth[{extra}]"'
        if name == "open3d" and find_spec(name):  # it may lack a library of the system
            state = _open3d()
        print(f"{name:20s} {state}")
    return 0


def _open3d() -> str:
    from ..errors import MissingDependency
    from ..observe.render import open3d_or_refuse

    try:
        open3d_or_refuse()
    except MissingDependency as error:
        return f"cannot be imported: {error.got}; {error.remedy}"
    return "installed"
