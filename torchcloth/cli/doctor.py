"""``torchcloth doctor``: report what is installed and what works."""

from __future__ import annotations

import argparse
from importlib import metadata
from typing import Any

OPTIONAL_PACKAGES = {
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
    """Add the verb ``doctor``."""
    doctor = verbs.add_parser("doctor", help="report what is installed and what works")
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
    for name, extra in OPTIONAL_PACKAGES.items():
        state = "installed" if find_spec(name) else f'missing: pip install "torchcloth[{extra}]"'
        if name == "open3d" and find_spec(name):  # a system library that it needs may be missing
            state = _open3d_status()
        print(f"{name:20s} {state}")
    return 0


def _open3d_status() -> str:
    from ..errors import MissingDependency
    from ..observe.render import import_open3d

    try:
        import_open3d()
    except MissingDependency as error:
        return f"cannot be imported: {error.got}; {error.remedy}"
    return "installed"
