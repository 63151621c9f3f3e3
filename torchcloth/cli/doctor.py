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
}


def add(verbs: Any) -> None:
    """The verb."""
    doctor = verbs.add_parser("doctor", help="say what is installed and what works")
    doctor.set_defaults(run=_doctor)


def _doctor(options: argparse.Namespace) -> int:
    from importlib.util import find_spec

    import torch

    from ..engine import library

    print(f"torchcloth {metadata.version('torchcloth')}, torch {torch.__version__}, CUDA {torch.cuda.is_available()}")
    print(f"{'engine':20s} {library.status()}")
    for name, extra in PACKAGES.items():
        state = "installed" if find_spec(name) else f'missing: pip install "torchcloth[{extra}]"'
        print(f"{name:20s} {state}")
    return 0
