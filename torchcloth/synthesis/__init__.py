"""Synthetic recordings: a robot moves garments or sheets, this engine simulates them, a depth camera records them.

A fit to these recordings uses the model that generated them (an inverse crime). They show whether a method works, not
how well it works on real cloth. Their provenance says so.
"""

from __future__ import annotations

from .episode_spec import CAMERAS, MOTIONS, EpisodeSpec
from .garments import GARMENTS
from .generate import make_episode

__all__ = ["CAMERAS", "GARMENTS", "MOTIONS", "EpisodeSpec", "make_episode"]
