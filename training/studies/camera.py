"""A camera's pose from the arm in its view: how far off, and do the intervals hold the truth?

A Rizon arm swings a cloth above a table, in a room. A Kinect or a stereo camera, at a random place, takes depth images
with all of its errors, those of the device too. Encoders are 0.2 degrees off, and images come late. No start is given.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from torchcloth import observe
from torchcloth._utils.constants import Z_95
from torchcloth.errors import TorchclothError
from torchcloth.inspection.camera_from_arm import JOINT_OFFSET_STD_RAD, ArmFunction, make_arm_function
from torchcloth.meshes import rectangle
from torchcloth.robots import Table, load  # pyright: ignore[reportMissingImports] - mapped from robots/

from ..resumable import ResumableStudy, check_jobs, write_result
from .manipulations.console_tables import heading_table, number, show

Array = np.ndarray
CAMERAS = ("kinect", "stereo")
IMAGE_COUNT = 10
ARM_MOTION_S = 4.0
TRUE_LAG_STD_S = 0.03  # true lag
SHRINK_FACTOR = 2  # of the images, along each side
CLOTH_SIZE_M = 0.3
TABLE_NOTE = (
    "off: distance of the pose from the truth, median (largest); std: its standard error, median; "
    "inside: share of the six numbers of all poses within their 95 % intervals"
)


class View(NamedTuple):
    """Images of an arm by a camera.

    Attributes:
        camera: at its true pose.
        depths: [T, H, W] m.
        arm: solids as a function of the arm's unknowns.
        arm_std: of these unknowns.
        lag: s, true lag of the images.
        times: [T] s, of the images, as their clock says.
        motion: times [K] s and joints [K, 7] rad, as the encoders say.
    """

    camera: observe.DepthCamera
    depths: Array
    arm: ArmFunction
    arm_std: Array
    lag: float
    times: Array
    motion: tuple[Array, Array]


def add(parser: argparse.ArgumentParser) -> None:
    """Add the study's options."""
    parser.add_argument("--seeds", type=int, default=24, metavar="N", help="views of each camera (default: 24)")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="cases at a time (default: 1)")


def run(options: argparse.Namespace) -> None:
    """Find the pose of every camera, print and write camera.json."""
    check_jobs(options.jobs)
    study = ResumableStudy(options.out, {"study": "camera"})
    seeds = range(2 if options.fast else options.seeds)
    cases = {f"{kind}-{seed}": partial(run_case, kind, seed) for kind in CAMERAS for seed in seeds}
    results = study.run(cases, options.jobs)
    show(_table(results), TABLE_NOTE)
    write_result(options.out / "camera.json", "camera", results)


def run_case(kind: str, seed: int) -> dict[str, Any]:
    """Find the pose of one camera."""
    view = make_view(kind, seed)
    try:
        pose = observe.find_camera_pose(view.camera, view.depths, view.arm, view.arm_std)
    except TorchclothError as error:
        return {"camera": kind, "error": str(error)}
    return {
        "camera": kind,
        "error": None,
        "is_determined": pose.is_determined,
        "off": (-pose.compare(view.camera.T_world_camera)).tolist(),
        "std": np.sqrt(np.diag(pose.covariance)).tolist(),
        "lag": [view.lag, float(pose.arm[0]), float(pose.arm_std[0])],
        "depth_scale": pose.depth_scale,
        "rms": pose.rms,
        "pixels": pose.pixels,
        "explained": pose.explained,
    }


def make_view(
    kind: str, seed: int, *, amplitude: float = 1.0, has_faults: bool = True, shrink: int = SHRINK_FACTOR
) -> View:
    """Render an arm that moves a cloth, as a camera at a random place sees it.

    Args:
        kind: "kinect" or "stereo".
        seed: of all that is random.
        amplitude: of the joints' motion, relative.
        has_faults: noise, late images and encoders that are off.
        shrink: of the images, along each side.
    """
    rng = np.random.default_rng(seed)
    arm = load("rizon4", frame="tcp_closed")
    size, phase, rate = rng.uniform(0.2, 0.5, 7), rng.uniform(0, 2 * np.pi, 7), rng.uniform(0.15, 0.4, 7)
    t = np.arange(-0.5, ARM_MOTION_S + 0.5, 0.01)
    q = arm.home.numpy() + amplitude * size * np.sin(2 * np.pi * rate * t[:, None] + phase)
    times = np.linspace(0, ARM_MOTION_S, IMAGE_COUNT)
    place, std = make_arm_function([arm], [(t, q)], times)
    lag = has_faults * TRUE_LAG_STD_S * float(rng.standard_normal())
    solids = place(np.array([lag, *has_faults * JOINT_OFFSET_STD_RAD * rng.standard_normal(7)]))
    camera, noise = _place_camera(rng, kind, shrink)
    bias = noise.bias_field((camera.height, camera.width), rng)
    tip = solids[-1].pose[:, :3, 3].numpy()
    room, depths = _room(), []
    for k in range(IMAGE_COUNT):
        bodies = [_cloth(rng, tip[k]), *observe.build_solid_meshes(solids, at=k), *room]
        depth, _ = observe.render_depth(camera, bodies)
        depths.append(noise.apply(depth, rng, bias) if has_faults else depth)
    return View(camera, np.stack(depths), place, std, lag, times, (t, q))


def _place_camera(
    rng: np.random.Generator, kind: str, shrink: int
) -> tuple[observe.DepthCamera, observe.AbstractNoise]:
    """Return a camera that looks at the arm from the table's side, with smaller images, and its noise in these."""
    target = np.array([0.45, 0.0, 0.35]) + rng.uniform(-0.1, 0.1, 3)
    azimuth, elevation, roll = rng.uniform([-1.0, 0.1, -0.3], [1.0, 0.8, 0.3])
    away = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    up = [0.0, np.sin(roll), np.cos(roll)]
    pose = observe.look_at(target + rng.uniform(1.1, 1.6) * away, target, np.array(up))
    make = observe.DepthCamera.azure_kinect_nfov if kind == "kinect" else observe.DepthCamera.realsense_d435
    full = make(pose)
    K = full.K / [[shrink], [shrink], [1]]
    camera = replace(full, width=full.width // shrink, height=full.height // shrink, K=K)
    if kind == "kinect":
        return camera, replace(observe.DepthNoise.azure_kinect(), bias_length=160 / shrink)
    noise = observe.StereoNoise.d435()
    lengths = ("focal", "subpixel", "patch", "step", "edge", "bias_disparity", "bias_length")
    return camera, replace(noise, fattening=1, **{name: getattr(noise, name) / shrink for name in lengths})


def _room() -> list[tuple[Array, Array]]:
    wall, floor = np.eye(4), np.eye(4)
    wall[0, 3], floor[2, 3] = -0.6, -0.8
    table = observe.build_solid_meshes([Table().primitive()])
    walls = [("box", (0.02, 6.0, 4.0), wall), ("box", (6.0, 6.0, 0.02), floor)]
    return [*table, *(observe.build_solid_mesh(*body) for body in walls)]


def _cloth(rng: np.random.Generator, tip: Array) -> tuple[Array, Array]:
    """A wavy cloth that hangs from the gripper by the middle of its upper edge, turned at random."""
    mesh = rectangle(CLOTH_SIZE_M, CLOTH_SIZE_M, triangles=250)
    assert mesh.uv is not None
    turn, (u, v) = rng.uniform(0, 2 * np.pi), mesh.uv.T
    along, across = np.array([np.cos(turn), np.sin(turn), 0.0]), np.array([-np.sin(turn), np.cos(turn), 0.0])
    wave = 0.03 * np.sin(20 * u + turn)
    x = tip + np.outer(u - CLOTH_SIZE_M / 2, along) + np.outer(wave, across) + np.outer(v - CLOTH_SIZE_M, [0, 0, 1.0])
    return x, mesh.faces


def _table(results: dict[str, dict[str, Any]]) -> Any:
    headings = "camera | views | no pose | off, mm | std, mm | off, deg | std, deg | inside"
    table = heading_table("Camera pose from the arm", *headings.split(" | "))
    for kind in CAMERAS:
        cases = [case for case in results.values() if case["camera"] == kind]
        solved = [case for case in cases if case["error"] is None and case["is_determined"]]
        off, std = (np.array([case[key] for case in solved]).reshape(-1, 6) for key in ("off", "std"))
        cells = [kind, str(len(cases)), str(len(cases) - len(solved))]
        for part, unit in ((slice(3), 1e3), (slice(3, 6), np.rad2deg(1))):
            errors, widths = (unit * np.linalg.norm(x[:, part], axis=1) for x in (off, std))
            if len(solved):
                cells += [f"{np.median(errors):.2g} ({errors.max():.2g})", f"{np.median(widths):.2g}"]
            else:
                cells += ["–", "–"]
        inside = (np.abs(off) < Z_95 * std).mean() if len(solved) else np.nan
        table.add_row(*cells, number(100 * inside) + " %" if len(solved) else "–")
    return table
