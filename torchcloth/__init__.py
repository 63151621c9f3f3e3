"""torchcloth: a differentiable cloth layer for robotics."""

__version__ = "0.1.0"
