"""The RGBench data set: its garments, captures and published means (Hu et al. 2026; data CC-BY-4.0, program MIT)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchcloth.errors import InvalidInput
from torchcloth.meshes import obj

LIBRARY_FILE, GARMENT_FOLDER, MESH_FOLDER = "experiment_library.yaml", "cloth_params", "meshes"
RGBENCH_ACTIONS = ("fling", "fold", "grasp")
KG_PER_M2_BY_DENSITY = 1e-3  # g/m^2; the data set states no units
N_PER_M_BY_STRETCH = 1e-3  # g/s^2, as Style3D has it
N_M_BY_BENDING = 1e-9  # g mm^2/s^2, likewise
NOMINAL_DAMPING_TIME_S = 4e-3
DEFAULT_GROUND_FRICTION = 0.4

# Mean Chamfer L1, real to simulated [m], "fixed point": results/paper_baselines.csv of the benchmark's repository.
PUBLISHED_SIMULATORS = ("MuJoCo with Style3D", "PyBullet", "Isaac Sim")
PUBLISHED_MEANS_M: dict[tuple[str, str], tuple[float, float, float]] = {
    ("beige_hoodie", "fling"): (0.0256, 0.0310, 0.0352),
    ("beige_hoodie", "fold"): (0.0225, 0.0240, 0.0302),
    ("beige_hoodie", "grasp"): (0.0217, 0.0275, 0.0308),
    ("blue_dress", "fling"): (0.0687, 0.0889, 0.0928),
    ("blue_dress", "fold"): (0.0187, 0.0331, 0.0459),
    ("blue_dress", "grasp"): (0.0221, 0.0433, 0.0490),
    ("brown_coat", "fling"): (0.0379, 0.1071, 0.0815),
    ("brown_coat", "fold"): (0.0279, 0.0309, 0.0346),
    ("brown_coat", "grasp"): (0.0320, 0.0573, 0.0605),
    ("green_tshirt", "fling"): (0.0419, 0.0532, 0.0567),
    ("green_tshirt", "fold"): (0.0132, 0.0227, 0.0314),
    ("green_tshirt", "grasp"): (0.0226, 0.0348, 0.0341),
    ("grey_pleat_skirt", "fling"): (0.0326, 0.0540, 0.0388),
    ("grey_pleat_skirt", "fold"): (0.0126, 0.0256, 0.0255),
    ("grey_pleat_skirt", "grasp"): (0.0159, 0.0241, 0.0201),
    ("white_cakeskirt", "fling"): (0.0406, 0.0588, 0.0598),
    ("white_cakeskirt", "fold"): (0.0179, 0.0266, 0.0308),
    ("white_cakeskirt", "grasp"): (0.0269, 0.0487, 0.0517),
    ("white_shirt", "fling"): (0.0422, 0.0518, 0.0600),
    ("white_shirt", "fold"): (0.0243, 0.0280, 0.0308),
    ("white_shirt", "grasp"): (0.0280, 0.0347, 0.0312),
}


@dataclass(frozen=True)
class Capture:
    """One capture and the window in which it is evaluated.

    Attributes:
        garment: name.
        action: one of ``RGBENCH_ACTIONS``.
        folder: of the capture.
        start, end: s after the first sample of the arms; the cloth is grasped at the start.
    """

    garment: str
    action: str
    folder: Path
    start: float
    end: float

    @property
    def name(self) -> str:
        """Names of garment and folder, for files and messages."""
        return f"{self.garment}, {self.folder.name}"

    @property
    def cell(self) -> tuple[str, str]:
        """Names of garment and action: a cell of the table."""
        return self.garment, self.action


@dataclass(frozen=True, eq=False)
class Garment:
    """A garment as the benchmark describes it.

    Attributes:
        vertices: [V, 3] m, lying flat.
        faces: [F, 3].
        areal_density: kg/m^2.
        nominal: values for ``ClothInfo.nominal``.
        ground_friction: Coulomb coefficient.
        shoulders: vertices that the left and the right gripper hold in a fling.
    """

    vertices: np.ndarray
    faces: np.ndarray
    areal_density: float
    nominal: dict[str, float]
    ground_friction: float
    shoulders: tuple[int, ...]


def list_captures(data: Path, configs: Path) -> list[Capture]:
    """List the captures of the library that are at hand.

    Args:
        data: folder of the data set.
        configs: folder ``configs`` of the benchmark's repository.

    Raises:
        InvalidInput: there is no library, or none of its captures.
    """
    experiments = _read_yaml(configs / LIBRARY_FILE).get("experiments")
    captures, missing = [], 0
    for garment, actions in _items(experiments):
        for action, robots in _items(actions):
            for _, samples in _items(robots):
                for _, entry in _items(samples):
                    capture = _to_capture(garment, action, entry, data, configs / LIBRARY_FILE)
                    if capture.folder.is_dir():
                        captures.append(capture)
                    else:
                        missing += 1
    if not captures:
        got, expected = f"none of {missing} captures", f"folders such as green_tshirt/green_tshirt_fold_... in {data}"
        raise InvalidInput("--data", got=got, expected=expected, remedy="download the data set, or name its folder")
    return captures


def select_captures(
    captures: Sequence[Capture], garments: Sequence[str] | None, actions: Sequence[str], count: int
) -> list[Capture]:
    """Return the first captures of each cell.

    Args:
        captures: all of them.
        garments: names; None: all.
        actions: names.
        count: captures of a cell at most.

    Raises:
        InvalidInput: a garment has no capture.
    """
    known = sorted({capture.garment for capture in captures})
    unknown = [name for name in garments or () if name not in known]
    if unknown:
        raise InvalidInput("--garments", got=unknown[0], expected=f"some of {', '.join(known)}")
    cells: dict[tuple[str, str], list[Capture]] = {}
    for capture in captures:
        if (garments is None or capture.garment in garments) and capture.action in actions:
            cells.setdefault(capture.cell, []).append(capture)
    return [capture for cell in sorted(cells) for capture in cells[cell][:count]]


def read_garment(name: str, data: Path, configs: Path) -> Garment:
    """Read the description and the mesh of a garment; the texture coordinates of the mesh are no pattern.

    Raises:
        InvalidInput: a file is missing, or lacks something.
        RecordingError: the mesh is damaged.
    """
    path = configs / GARMENT_FOLDER / f"{name}.yaml"
    entries = _read_yaml(path)
    mesh_path = data / MESH_FOLDER / str(entries.get("cloth_model_file_name"))
    if not mesh_path.is_file():
        raise InvalidInput(f"{path}: cloth_model_file_name", got=mesh_path, expected="a mesh of the data set")
    vertices, faces, _ = obj.parse(mesh_path.read_text(), str(mesh_path))
    friction = entries.get("ground_friction", entries.get("friction", DEFAULT_GROUND_FRICTION))
    shoulders = tuple(int(k) for k in entries.get("shoulder_index") or ())
    if not all(0 <= k < len(vertices) for k in shoulders):
        raise InvalidInput(f"{path}: shoulder_index", got=list(shoulders), expected=f"vertices below {len(vertices)}")
    nominal = {
        "membrane_stiffness": N_PER_M_BY_STRETCH * _number(entries, "stretch", path),
        "poisson_ratio": _number(entries, "poisson", path),
        "bending_stiffness": N_M_BY_BENDING * _number(entries, "bending", path),
        "bending_damping_time": NOMINAL_DAMPING_TIME_S,
    }
    density = KG_PER_M2_BY_DENSITY * _number(entries, "density", path)
    return Garment(vertices, faces, density, nominal, float(friction), shoulders)


def _to_capture(garment: str, action: str, entry: Any, data: Path, path: Path) -> Capture:
    try:
        window = entry["evaluate"]
        start, end = float(window["start_calculate_time"]), float(window["end_calculate_time"])
        return Capture(garment, action, data / str(entry["data_subfolder"]), start, end)
    except (KeyError, TypeError, ValueError) as error:
        expected = "data_subfolder, and evaluate with start_calculate_time and end_calculate_time"
        raise InvalidInput(f"{path}: {garment}, {action}", got=repr(error)[:60], expected=expected) from None


def _read_yaml(path: Path) -> Mapping[str, Any]:
    import yaml

    try:
        content = yaml.safe_load(path.read_text())
    except (OSError, ValueError, yaml.YAMLError) as error:
        remedy = "name the folder configs of a clone of github.com/hwk0809/RGBench"
        reason = getattr(error, "strerror", None) or type(error).__name__
        raise InvalidInput("--configs", got=f"{path}: {reason}", expected="a YAML file", remedy=remedy) from None
    if not isinstance(content, dict):
        raise InvalidInput("--configs", got=f"{path}: {type(content).__name__}", expected="an object of named values")
    return content


def _items(entries: Any) -> list[tuple[str, Any]]:
    return [(str(key), value) for key, value in entries.items()] if isinstance(entries, dict) else []


def _number(entries: Mapping[str, Any], key: str, path: Path) -> float:
    """Return a number, or the mean of warp and weft where there are several."""
    try:
        value = float(np.mean(np.asarray(entries[key], dtype=float).reshape(-1)[:2]))
    except (KeyError, TypeError, ValueError):
        value = np.nan
    if not np.isfinite(value):
        raise InvalidInput(f"{path}: {key}", got=repr(entries.get(key)), expected="a number")
    return value
