"""Reinforcement learning in the scenes of ``torchcloth plan``; needs the extra ``rl``."""

from .env import ReachEnv
from .sac import learn

__all__ = ["ReachEnv", "learn"]
