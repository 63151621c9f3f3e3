"""Synthetic recordings: garments and sheets moved by a robot, simulated by this engine, seen by a depth camera.

What a fit recovers from them it recovers under the very model that made them (an inverse crime): they show whether a
method works at all, never how well it does on cloth. Their provenance says so.
"""

from __future__ import annotations

from .episode_spec import CAMERAS, MOTIONS, Order
from .garments import GARMENTS
from .generate import make

__all__ = ["CAMERAS", "GARMENTS", "MOTIONS", "Order", "make"]
