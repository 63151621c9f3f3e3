"""A network that sees one partial cloud of a cloth, and says where each of its vertices is, with a standard deviation.

Vertices ask the cloud: tokens of the vertices, made of their places on the fabric, attend to tokens of the points. So
one network serves every mesh. A first stage answers with several hypotheses (folded cloth has several right shapes).
Further stages look at the points near each vertex and correct it, as a registration does.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from ..errors import InvalidInput
from .scene_frame import PoseInputs, SceneFrame, build_scene_frame

FABRIC_PARAMETERS = ("membrane_stiffness", "bending_stiffness", "air_normal")  # N/m, N m, -; estimated as logarithms
# About the middle of the fabrics that the network is trained with.
MEAN_LOG_FABRIC, STD_LOG_FABRIC = (5.3, -9.8, 0.1), (1.0, 1.0, 0.3)
MIN_LOG_STD, MAX_LOG_STD = -7.0, 1.0  # of a position, in the scene's unit of length
LOCAL_RADIUS = 0.1  # unit of the offsets of near points, in the scene's unit of length


@dataclass(frozen=True)
class PoseNetworkConfig:
    """Size of a `PoseEstimator`.

    Attributes:
        width: of a token.
        heads: of the attention.
        point_blocks: blocks in which a few latent tokens take up the cloud.
        latents: number of these tokens.
        vertex_blocks: blocks of the vertices before the first answer.
        refinements: stages that correct the answer.
        hypotheses: answers of the first stage.
        neighbours: points near a vertex that a refinement looks at.
        frequencies: octaves of the Fourier features of a position.
    """

    width: int = 96
    heads: int = 4
    point_blocks: int = 2
    latents: int = 48
    vertex_blocks: int = 3
    refinements: int = 3
    hypotheses: int = 4
    neighbours: int = 8
    frequencies: int = 5


class PosePrediction(NamedTuple):
    """Where the vertices of B scenes are.

    Attributes:
        x: [B, V, 3] m, of the likeliest hypothesis, in the world.
        std: [B, V] m, standard deviation of each coordinate of it.
        v: [B, V, 3] m/s, velocities.
        hypotheses: [B, S, V, 3] m, refined, the likeliest first.
        hypothesis_std: [B, S, V] m.
        weights: [B, S], probabilities of the hypotheses among themselves.
        log_fabric: [B, 3], logarithms of `FABRIC_PARAMETERS` in SI units.
        log_fabric_std: [B, 3].
    """

    x: Tensor
    std: Tensor
    v: Tensor
    hypotheses: Tensor
    hypothesis_std: Tensor
    weights: Tensor
    log_fabric: Tensor
    log_fabric_std: Tensor


class StageOutputs(NamedTuple):
    """What training compares with the truth, in the scene's frame and unit of length.

    Attributes:
        frame: of the scenes.
        hypotheses: [B, K, V, 3] of the first stage.
        logits: [B, K] of the hypotheses' weights.
        chosen: [B] index of the hypothesis that was refined.
        stages: list of [B, V, 3], after each refinement.
        log_std: [B, V] of the last stage.
        v: [B, V, 3] velocity, in units of length per second.
        log_fabric: [B, 3], with mean zero and variance one over the training fabrics.
        log_fabric_log_std: [B, 3].
    """

    frame: SceneFrame
    hypotheses: Tensor
    logits: Tensor
    chosen: Tensor
    stages: list[Tensor]
    log_std: Tensor
    v: Tensor
    log_fabric: Tensor
    log_fabric_log_std: Tensor


class PoseEstimator(nn.Module):
    """Positions of a cloth's vertices from one partial cloud, for any mesh.

    Equivariant to translations and to turns about the vertical, by the choice of the scene's frame.

    Args:
        config: its size.

    Example:
        >>> network = PoseEstimator()
        >>> prediction = network(inputs)  # PoseInputs of B scenes
        >>> prediction.x, prediction.std  # [B, V, 3] m, [B, V] m
    """

    std_factor: Tensor

    def __init__(self, config: PoseNetworkConfig | None = None) -> None:
        super().__init__()
        self.config = config = config or PoseNetworkConfig()
        if config.width % config.heads:
            raise InvalidInput("width", got=config.width, expected=f"a multiple of heads = {config.heads}")
        width, position = config.width, 3 * (1 + 2 * config.frequencies)
        self.embed_scene = _mlp(14, width, width)
        self.embed_points = _mlp(position + 6, width, width)
        self.embed_vertices = _mlp(2 * position + 8, width, width)
        self.latents = nn.Parameter(0.02 * torch.randn(config.latents, width))
        self.point_blocks = nn.ModuleList(_Block(width, config.heads) for _ in range(config.point_blocks))
        self.vertex_blocks = nn.ModuleList(_Block(width, config.heads) for _ in range(config.vertex_blocks))
        self.to_hypotheses = nn.Linear(width, 3 * config.hypotheses)
        self.to_weights = _mlp(width, width, config.hypotheses)
        self.embed_near_points = _mlp(4, width // 2, width)
        self.embed_stage = _mlp(2 * width + position, width, width)
        self.refinements = nn.ModuleList(_Block(width, config.heads) for _ in range(config.refinements))
        self.to_correction = nn.ModuleList(nn.Linear(width, 3) for _ in range(config.refinements))
        self.to_log_std, self.to_velocity = _mlp(width, width, 1), _mlp(width, width, 3)
        self.to_fabric = _mlp(width, width, 2 * len(FABRIC_PARAMETERS))
        self.register_buffer("std_factor", torch.ones(()))
        with torch.no_grad():  # the first answer of an untrained network is cloth that hangs
            for layer in (self.to_hypotheses, *self.to_correction):
                for value in layer.parameters():
                    value.mul_(0.01)

    @property
    def description(self) -> dict[str, int]:
        """The config as plain numbers, to be stored beside the weights."""
        return asdict(self.config)

    def forward(self, inputs: PoseInputs, samples: int = 1) -> PosePrediction:
        """Estimate the vertices.

        Args:
            inputs: of B scenes.
            samples: number of hypotheses that are refined and returned, at most ``config.hypotheses``.

        Raises:
            InvalidInput: a number of samples that is out of range.
        """
        if not 1 <= samples <= self.config.hypotheses:
            raise InvalidInput("samples", got=samples, expected=f"1 to {self.config.hypotheses}")
        tokens = self._encode(inputs)
        order = tokens.logits.argsort(-1, descending=True)[:, :samples]
        refined = [self._refine(tokens, order[:, k]) for k in range(samples)]
        x = torch.stack([tokens.frame.to_world(stages[-1]) for stages, _ in refined], 1)
        log_std = torch.stack([self._log_std(h) for _, h in refined], 1)
        std = self.std_factor * log_std.exp() * tokens.frame.scale[:, None]
        v = tokens.frame.turn_to_world(self.to_velocity(refined[0][1]) * tokens.frame.scale[:, None])
        v = v + self._mean_grip_velocity(inputs)
        mean, spread = x.new_tensor(MEAN_LOG_FABRIC), x.new_tensor(STD_LOG_FABRIC)
        log_fabric = mean + spread * tokens.fabric[:, 0]
        weights = tokens.logits.softmax(-1).gather(1, order)
        weights = weights / weights.sum(-1, keepdim=True)
        return PosePrediction(x[:, 0], std[:, 0], v, x, std, weights, log_fabric, spread * tokens.fabric[:, 1].exp())

    def compute_stages(self, inputs: PoseInputs, truth: Tensor) -> StageOutputs:
        """Return the answers of all stages, for training.

        The hypothesis nearest to the truth [B, V, 3] m is refined, or the likeliest one where the truth is NaN.
        """
        tokens = self._encode(inputs)
        with torch.no_grad():
            apart = (tokens.hypotheses - tokens.frame.to_scene(truth)[:, None]).norm(dim=-1)
            apart = masked_mean(apart, inputs.exists[:, None])
            chosen = torch.where(apart.isfinite().all(-1), apart.argmin(-1), tokens.logits.argmax(-1))
        stages, h = self._refine(tokens, chosen)
        v = (
            self.to_velocity(h)
            + tokens.frame.turn_to_scene(self._mean_grip_velocity(inputs)) / tokens.frame.scale[:, None]
        )
        fabric = tokens.fabric
        return StageOutputs(
            tokens.frame,
            tokens.hypotheses,
            tokens.logits,
            chosen,
            stages,
            self._log_std(h),
            v,
            fabric[:, 0],
            fabric[:, 1],
        )

    # -- parts ------------------------------------------------------------------------------------------------------

    def _encode(self, inputs: PoseInputs) -> _Tokens:
        frame, octaves = build_scene_frame(inputs), self.config.frequencies
        rest = frame.rest_to_scene(inputs.rest)
        hanging = frame.hang(rest)
        points = frame.to_scene(inputs.points)
        has_grip = inputs.grip_position.isfinite().all(-1)
        grips = frame.to_scene(inputs.grip_position.nan_to_num()).where(has_grip[..., None], 0.0)
        velocity = frame.turn_to_scene(inputs.grip_velocity.nan_to_num()) / frame.scale[:, None]
        scene = self.embed_scene(
            torch.cat(
                [
                    frame.scale.log(),
                    frame.spread,
                    frame.rise,
                    has_grip.to(rest),
                    velocity.flatten(1),
                    (rest * inputs.exists[..., None]).amin(1),
                ],
                -1,
            )
        )[:, None]
        to_grips = (points[:, :, None] - grips[:, None]).flatten(2)
        cloud = self.embed_points(torch.cat([fourier_features(points, octaves), to_grips], -1)) + scene
        latents = self.latents.expand(len(rest), -1, -1) + scene
        for block in self.point_blocks:
            latents = block(latents, cloud)
        before = frame.to_scene(inputs.previous)
        has_before = before.isfinite().all(-1, keepdim=True)
        moved = (before - hanging).nan_to_num()
        is_held = torch.stack([inputs.grip == k for k in (1, 2)], -1).to(rest)
        features = [
            fourier_features(rest, octaves),
            fourier_features(hanging, octaves),
            is_held,
            moved,
            has_before.to(rest),
        ]
        reach = torch.stack([rest[..., 0].abs(), rest[..., :2].norm(dim=-1)], -1)
        h = self.embed_vertices(torch.cat([*features, reach], -1)) + scene
        for block in self.vertex_blocks:
            h = block(h, latents, inputs.exists)
        start = torch.where(has_before, before.nan_to_num(), hanging)
        offsets = self.to_hypotheses(h).unflatten(-1, (-1, 3)).transpose(1, 2)  # [B, K, V, 3]
        pooled = latents.mean(1) + masked_mean(h.transpose(1, 2), inputs.exists[:, None])
        fabric = self.to_fabric(pooled).unflatten(-1, (2, -1))
        return _Tokens(frame, inputs, points, latents, h, start[:, None] + offsets, self.to_weights(pooled), fabric)

    def _refine(self, tokens: _Tokens, chosen: Tensor) -> tuple[list[Tensor], Tensor]:
        """Positions after each stage, and the last tokens of the vertices."""
        x, h, stages = tokens.hypotheses[torch.arange(len(chosen)), chosen], tokens.h, []
        for block, to_correction in zip(self.refinements, self.to_correction, strict=True):
            near = self._near_features(x, tokens.points)
            h = h + self.embed_stage(torch.cat([h, near, fourier_features(x, self.config.frequencies)], -1))
            h = block(h, tokens.latents, tokens.inputs.exists)
            x = x + to_correction(h)
            stages.append(x)
        return stages, h

    def _near_features(self, x: Tensor, points: Tensor) -> Tensor:
        """[B, V, width] of the points near each vertex, whose offsets carry gradients to the positions."""
        count = min(self.config.neighbours, points.shape[1])
        with torch.no_grad():
            nearest = torch.cdist(x, points).topk(count, largest=False).indices  # [B, V, k]
        batch = torch.arange(len(x), device=x.device)[:, None, None]
        offsets = (points[batch, nearest] - x[:, :, None]) / LOCAL_RADIUS
        distance = (offsets.square().sum(-1, keepdim=True) + 1e-6).sqrt()
        return self.embed_near_points(torch.cat([offsets / (1 + distance), (1 + distance).log()], -1)).amax(2)

    def _log_std(self, h: Tensor) -> Tensor:
        return self.to_log_std(h)[..., 0].sub(4.0).clamp(MIN_LOG_STD, MAX_LOG_STD)

    def _mean_grip_velocity(self, inputs: PoseInputs) -> Tensor:
        """[B, 1, 3] m/s."""
        has_grip = inputs.grip_position.isfinite().all(-1, keepdim=True).to(inputs.grip_velocity)
        total = (inputs.grip_velocity.nan_to_num() * has_grip).sum(1, keepdim=True)
        return total / has_grip.sum(1, keepdim=True).clamp_min(1.0)


class _Tokens(NamedTuple):
    frame: SceneFrame
    inputs: PoseInputs
    points: Tensor  # [B, N, 3] in the scene
    latents: Tensor  # [B, L, width]
    h: Tensor  # [B, V, width]
    hypotheses: Tensor  # [B, K, V, 3] in the scene
    logits: Tensor  # [B, K]
    fabric: Tensor  # [B, 2, 3] mean and logarithm of the standard deviation


class _Block(nn.Module):
    """Tokens attend to a context, then to themselves, then each passes a small network; all on normalised inputs."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.cross, self.inner = _Attention(width, heads), _Attention(width, heads)
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(4))
        self.mlp = _mlp(width, 2 * width, width)

    def forward(self, h: Tensor, context: Tensor, exists: Tensor | None = None) -> Tensor:
        h = h + self.cross(self.norms[0](h), self.norms[1](context))
        inner = self.norms[2](h)
        h = h + self.inner(inner, inner, exists)
        return h + self.mlp(self.norms[3](h))


class _Attention(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query, self.key_value, self.out = (
            nn.Linear(width, width),
            nn.Linear(width, 2 * width),
            nn.Linear(width, width),
        )

    def forward(self, h: Tensor, context: Tensor, exists: Tensor | None = None) -> Tensor:
        q = self.query(h).unflatten(-1, (self.heads, -1)).transpose(1, 2)
        k, v = self.key_value(context).unflatten(-1, (2, self.heads, -1)).permute(2, 0, 3, 1, 4)
        mask = None if exists is None else exists[:, None, None]
        return self.out(functional.scaled_dot_product_attention(q, k, v, mask).transpose(1, 2).flatten(2))


def fourier_features(positions: Tensor, octaves: int) -> Tensor:
    """Return positions [..., 3], and their sines and cosines at octaves of half a turn per unit, [..., 3 (1 + 2 n)]."""
    angles = positions[..., None] * (torch.pi / 2 * 2.0 ** torch.arange(octaves, device=positions.device)).to(positions)
    return torch.cat([positions, angles.sin().flatten(-2), angles.cos().flatten(-2)], -1)


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Return the mean of values [..., V] over those of the mask [..., V]."""
    weight = mask.to(values)
    return (values * weight).sum(-1) / weight.sum(-1).clamp_min(1.0)


def _mlp(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, hidden), nn.GELU(), nn.Linear(hidden, outputs))
