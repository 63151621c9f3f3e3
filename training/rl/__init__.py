"""Reinforcement learning on the same scenes as ``torchcloth plan``; needs the extra ``rl``."""

from .env import ReachEnv
from .sac import learn

__all__ = ["ReachEnv", "learn"]
