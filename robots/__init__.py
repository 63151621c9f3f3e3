"""Robots: kinematics from URDF, ours or the user's own, as differentiable torch modules."""

if __name__ != "torchcloth.robots":
    raise ImportError(f"got {__name__!r}; import this package as torchcloth.robots")
