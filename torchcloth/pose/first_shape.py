"""The first shape of a recording, from its first clouds, by a trained network and the simulation of what follows."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from .._utils.files import write_atomically
from .._utils.torch_modes import isolated_grad_mode
from ..boundaries import Grasp
from ..boundaries.motion import interpolate_poses
from ..cloth import Cloth
from ..episodes.observed import Episode, build_episode
from ..errors import InvalidInput, RecordingError, SimulationDiverged
from ..losses import chamfer_to_surface
from ..meshes import Mesh
from ..observe.align import MAX_EDGE_STRAIN, edge_strain
from ..recordings import Recording
from .consistent_state import make_consistent
from .network import PoseEstimator, PoseNetworkConfig, PosePrediction
from .scene_frame import PoseInputs, build_scene_frame, move_to_grippers, rest_coordinates

SHIPPED_NETWORK = Path(__file__).with_name("pose_network.safetensors")
NETWORK_FORMAT = "torchcloth-pose-network-1"
POINTS_SEEN = 256  # of a cloud, as in training
VELOCITY_FIT_S, MIN_VELOCITY_CLOUDS = 0.14, 3  # after the first cloud, through which a parabola is laid
MAX_PARABOLA_RESIDUAL_M = 0.01  # rms over vertices, above which answers jump from one side of the cloth to the other
VELOCITY_STEP_S = 0.01  # of the difference that gives a gripper's velocity
SINGLE_CLOUD_PERIOD_S = 1e-3
SIMULATED_FRAMES = 6  # with which hypotheses are compared
MAX_RIVAL_RATIO = (
    1.5  # of the distance from the clouds to that of the best hypothesis, for one that may be true as well
)
MAX_RIVAL_DISTANCE_RATIO = (
    0.1  # of the distance from such a hypothesis to the cloth's extent, above which it is another
)
MAX_NETWORK_BYTES = 50_000_000


class FirstShape(NamedTuple):
    """The shape of a cloth at the first frame.

    Attributes:
        mesh: of the cloth, whose vertices these are.
        x: [V, 3] m, of the hypothesis that predicts the next clouds best.
        std: [V] m, standard deviation of a coordinate.
        v: [V, 3] m/s; None: from a single cloud, of which the cloth is taken to be at rest.
        distances: [S] m, distance of the first cloud from each hypothesis, before it was moved to the cloud, and the
            mean distance of the next clouds from its simulation, averaged; NaN: the simulation diverged.
        weights: [S], what the network gave each hypothesis.
        rival_distance: root mean square distance [m] of the hypothesis that is farthest from ``x`` among those that
            follow the clouds almost as well; 0: there is none.
    """

    mesh: Mesh
    x: Tensor
    std: Tensor
    v: Tensor | None
    distances: Tensor
    weights: Tensor
    rival_distance: float

    @property
    def warnings(self) -> list[str]:
        """A warning where the clouds do not tell the shape from another one."""
        if not self.rival_distance > MAX_RIVAL_DISTANCE_RATIO * self.mesh.extent:
            return []
        return [
            f"the first shape is one of several: another one, {1e3 * self.rival_distance:.0f} mm away (rms), follows "
            "the first clouds almost as well, and no standard error says so; hold the cloth at two places, or give "
            "cloth.initial_vertices"
        ]

    @property
    def std_rms(self) -> float:
        """Root mean square over vertices of the standard deviation [m]: of the nuisance "shape"."""
        return float(self.std.square().mean().sqrt())

    def apply(self, recording: Recording) -> Recording:
        """Return the recording on the cloth's mesh, with this first shape and its velocities, for any further use."""
        mesh, v = self.mesh, None if self.v is None else self.v.double().numpy()
        info = replace(
            recording.cloth,
            vertices=mesh.vertices,
            faces=mesh.faces,
            uv=mesh.uv,
            initial_vertices=self.x.double().numpy(),
            initial_velocities=v,
        )
        return replace(recording, cloth=info)


# -- weights ----------------------------------------------------------------------------------------------------------


def save_network(network: PoseEstimator, path: Path) -> None:
    """Write the weights of a network, in half precision, and its size."""
    tensors = {name: value.detach().half().contiguous() for name, value in network.state_dict().items()}
    metadata = {"format": NETWORK_FORMAT, "config": json.dumps(network.description)}
    with write_atomically(path) as part:
        save_file(tensors, part, metadata)


def load_network(path: Path | None = None) -> PoseEstimator:
    """Read a network that `save_network` wrote; None: the one that is shipped. It runs no code of the file.

    Raises:
        InvalidInput: a file that is no such network.
    """
    path = SHIPPED_NETWORK if path is None else Path(path)
    if not path.is_file() or path.stat().st_size > MAX_NETWORK_BYTES:
        got = "a file that is too large" if path.is_file() else "no such file"
        raise InvalidInput(f"{path}: network", got=got, expected="weights of python -m torchcloth.training.pose")
    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name).float() for name in file.keys()}  # noqa: SIM118 - no mapping
        if metadata.get("format") != NETWORK_FORMAT:
            raise ValueError(f"format {metadata.get('format')!r}")
        with torch.device("meta"):
            network = PoseEstimator(_read_config(metadata["config"]))
        network.load_state_dict(tensors, assign=True)
    except Exception as error:
        reason = str(error).strip().splitlines()[0][:200]
        raise InvalidInput(
            f"{path}: network", got=reason, expected=f"weights in the format {NETWORK_FORMAT} (safetensors)"
        ) from None
    if not all(bool(value.isfinite().all()) for value in tensors.values()):
        raise InvalidInput(f"{path}: network", got="weights that are not finite", expected="finite numbers")
    return network.eval()


def _read_config(text: str) -> PoseNetworkConfig:
    numbers = json.loads(text)
    if not all(isinstance(value, int) and 1 <= value <= 1024 for value in numbers.values()):
        raise ValueError("config: sizes must be whole numbers from 1 to 1024")
    return PoseNetworkConfig(**numbers)


# -- a recording's clouds as the network's inputs ---------------------------------------------------------------------


def pose_inputs(
    cloth: Cloth, episode: Episode, frame: int, rest: Tensor, previous: Tensor | None = None, seed: int = 0
) -> PoseInputs:
    """Return what the network sees of one frame, as a batch of one.

    A gripper's frame lies at the middle of the places that its grasp names, and the network is told the centre of all
    that it holds. How far that is, is known, and its direction is taken to be that of cloth that hangs.

    Args:
        cloth: of the episode.
        episode: clouds and grippers' motion.
        frame: its index.
        rest: [V, 3] m, rest coordinates of the vertices.
        previous: [V, 3] m, the estimate of the frame before.
        seed: of the points that are drawn.

    Raises:
        RecordingError: the frame has no points.
    """
    cloud = episode.clouds[frame]
    if not len(cloud):
        raise RecordingError(f"{episode.name}: frame {frame}", got="no points", expected="a cloud for the network")
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.cat([torch.randperm(len(cloud), generator=generator) for _ in range(-(-POINTS_SEEN // len(cloud)))])
    grip = torch.zeros(len(rest), dtype=torch.int64)
    position, velocity, offset = rest.new_full((2, 3), torch.nan).float(), *rest.new_zeros(2, 2, 3).float()
    for k, name in enumerate(find_grippers(cloth, rest)):
        boundary, trajectory = cloth.boundaries[name], episode.motion[name]
        assert isinstance(boundary, Grasp)
        first, last = float(trajectory.t[0]), float(trajectory.t[-1])
        now = float(episode.times[frame])
        times = torch.tensor([max(first, now - VELOCITY_STEP_S), now, min(last, now + VELOCITY_STEP_S)])
        places = interpolate_poses(trajectory, times.to(trajectory.t))[:, :3, 3].float()
        grip[boundary.index] = k + 1
        position[k], velocity[k] = places[1], (places[2] - places[0]) / float(times[2] - times[0])
        if boundary.uv is not None:
            offset[k, :2] = rest[boundary.index, :2].mean(0) - torch.as_tensor(boundary.uv).mean(0)
    before = rest.new_full((len(rest), 3), torch.nan).float() if previous is None else previous.float()
    parts = (cloud[drawn[:POINTS_SEEN]].float(), rest.float(), torch.ones(len(rest), dtype=torch.bool), grip)
    inputs = PoseInputs(*(part.unsqueeze(0) for part in (*parts, position, velocity, before)))
    scene = build_scene_frame(inputs)
    hanging = scene.hang(torch.einsum("bij,bkj->bki", scene.rest_axes, offset[None]))
    return inputs._replace(grip_position=inputs.grip_position + scene.turn_to_world(hanging))


def find_grippers(cloth: Cloth, rest: Tensor) -> list[str]:
    """Return the names of at most two grasps, those that are farthest apart on the fabric."""
    names = [name for name, part in cloth.boundaries.items() if isinstance(part, Grasp)]
    if len(names) <= 2:
        return names
    centres = torch.stack([rest[cloth.boundaries[name].index].mean(0) for name in names])  # type: ignore[index]
    apart = torch.cdist(centres, centres)
    return [names[k] for k in divmod(int(apart.argmax()), len(names))]


# -- the first shape --------------------------------------------------------------------------------------------------


@isolated_grad_mode()
def estimate_first_shape(
    cloth: Cloth, recording: Recording, network: PoseEstimator | None = None, samples: int = 4
) -> FirstShape:
    """Estimate the shape at the first frame from its cloud, and choose among hypotheses by what follows.

    Each hypothesis is moved to the nearest state without stretch (`make_consistent`), then simulated along the
    grippers' motion with the cloth's values. The one from which the next clouds are least far is returned.

    Args:
        cloth: the model, with fitted or nominal values.
        recording: one episode of it, whose own first shape is not looked at.
        network: None: the one that is shipped.
        samples: number of hypotheses.

    Raises:
        RecordingError: no cloud at the first frame, or a shape that no cloth has.
    """
    network = network or load_network()
    bare = without_first_shape(recording)
    is_single = recording.points is not None and len(recording.points) == 1
    episode = build_episode(cloth, _with_second_cloud(bare) if is_single else bare, has_first_shape=False)
    rest = rest_coordinates(cloth.mesh)
    with torch.no_grad():
        inputs = pose_inputs(cloth, episode, 0, rest)
        first = network(inputs, samples)
        std, weights = first.hypothesis_std[0], first.weights[0]
        hypotheses = torch.cat(
            [move_to_grippers(x[None], s[None], inputs) for x, s in zip(first.hypotheses[0], std, strict=True)]
        )
        now = _distances_now(cloth, episode, hypotheses)
        if is_single:
            rival = _rival_distance(hypotheses, now, 0)
            return FirstShape(cloth.mesh, hypotheses[0], std[0], None, now, weights, rival)
        velocities = _velocities(network, cloth, episode, rest, first, hypotheses)
        gripped = inputs.grip[0].nonzero()[:, 0]
        states = [
            make_consistent(cloth.mesh, x, v, s, gripped, inputs.points[0])
            for x, v, s in zip(hypotheses, velocities, std, strict=True)
        ]
        hypotheses, velocities = (torch.stack(parts) for parts in zip(*states, strict=True))
        ahead = torch.stack(
            [_distance_ahead(cloth, episode, x, v) for x, v in zip(hypotheses, velocities, strict=True)]
        )
    distances = (now + ahead) / 2
    best = int(distances.nan_to_num(torch.inf).argmin())
    strain = float(edge_strain(cloth.mesh, hypotheses[best]).abs().max())
    if not strain <= MAX_EDGE_STRAIN:
        raise RecordingError(
            f"{episode.name}: first shape by the network",
            got=f"an edge strained by {strain:.2g} between what the cloud shows and what the grippers hold",
            expected=f"at most {MAX_EDGE_STRAIN:g}",
            remedy="check that the gripper's frame lies where it holds the cloth, and the size of the cloth; "
            "else give cloth.initial_vertices",
        )
    rival = _rival_distance(hypotheses, distances, best)
    x, v = hypotheses[best].to(episode.initial), velocities[best].to(episode.initial)
    return FirstShape(cloth.mesh, x, std[best], v, distances, weights, rival)


def _rival_distance(hypotheses: Tensor, distances: Tensor, best: int) -> float:
    """Largest rms distance [m] from hypothesis ``best`` of those [S, V, 3] whose distances [S] are almost as small."""
    is_rival = distances <= MAX_RIVAL_RATIO * distances[best]
    apart = (hypotheses - hypotheses[best]).square().sum(-1).mean(-1).sqrt()
    return float(apart[is_rival].max()) if bool(is_rival.any()) else 0.0


def without_first_shape(recording: Recording) -> Recording:
    """Return the recording without its own first shape and velocities."""
    return replace(recording, cloth=replace(recording.cloth, initial_vertices=None, initial_velocities=None))


def _with_second_cloud(recording: Recording) -> Recording:
    """The recording with its only cloud once more, as an episode needs two; the second one is not looked at."""
    points = recording.require("points")
    times = np.array([points.t[0], points.t[0] + SINGLE_CLOUD_PERIOD_S])
    twice = replace(points, t=times, xyz=np.tile(points.xyz, (2, 1)), counts=np.tile(points.counts, 2))
    return replace(recording, points=twice)


def _distances_now(cloth: Cloth, episode: Episode, hypotheses: Tensor) -> Tensor:
    """Mean distance [S] m of the first cloud from each hypothesis."""
    cloud, faces = episode.clouds[0].float(), torch.as_tensor(cloth.mesh.faces)
    return torch.stack([chamfer_to_surface(cloud, x, faces) for x in hypotheses])


def _velocities(
    network: PoseEstimator, cloth: Cloth, episode: Episode, rest: Tensor, first: PosePrediction, hypotheses: Tensor
) -> Tensor:
    """Velocity [S, V, 3] m/s of each hypothesis: the slope of a parabola through the answers to the next clouds.

    The answers to clouds that follow each other have most of their error in common, so their differences say more than
    the velocity that the network sees in one cloud. That one is taken where too few clouds come in time, or where the
    answers jump.
    """
    times = episode.times - episode.times[0]
    frames = [t for t in range(1, len(times)) if float(times[t]) <= VELOCITY_FIT_S and len(episode.clouds[t])]
    if len(frames) < MIN_VELOCITY_CLOUDS:
        return first.v.expand(len(hypotheses), -1, -1)
    path, samples = [hypotheses], first.hypotheses.shape[1]
    for t in frames:
        answers = network(pose_inputs(cloth, episode, t, rest), samples).hypotheses[0]
        apart = (path[-1][:, None] - answers).square().sum((-2, -1))
        path.append(answers[apart.argmin(1)])
    t, x = times[[0, *frames]].double(), torch.stack(path).double().flatten(2)
    powers = torch.stack([torch.ones_like(t), t, t.square()], 1)
    coefficients = torch.linalg.lstsq(powers, x.flatten(1)).solution.unflatten(1, x.shape[1:])
    residual = (x - torch.einsum("tk,ksn->tsn", powers, coefficients)).square().sum(-1).mean(0)
    jumps = (residual / hypotheses.shape[1]).sqrt() > MAX_PARABOLA_RESIDUAL_M
    slope = coefficients[1].reshape(hypotheses.shape).to(hypotheses)
    return torch.where(jumps[:, None, None], first.v.to(hypotheses), slope)


def _distance_ahead(cloth: Cloth, episode: Episode, x: Tensor, v: Tensor) -> Tensor:
    """Mean distance [m] of the next clouds from the simulation that begins here; NaN where it diverges."""
    times = episode.times[: 1 + SIMULATED_FRAMES]
    state = cloth.state(x.to(episode.initial), v.to(episode.initial))
    try:
        frames = cloth(state, episode.motion, times.tolist()).x if len(times) > 1 else state.x[None]
    except SimulationDiverged:
        return x.new_tensor(torch.nan)
    faces = torch.as_tensor(cloth.mesh.faces)
    distances = [
        chamfer_to_surface(cloud, frame, faces).to(x)
        for cloud, frame in zip(episode.clouds, frames, strict=False)
        if len(cloud)
    ]
    return torch.stack(distances).mean()
