"""What is in a recording and how far it can be trusted, before anything is fitted to it.

report = inspection.inspect(recordings.read("episodes/ep_01"))
inspection.show(report)
inspection.draw(report, "out/ep_01")
"""

from ..recordings.timing import Stream
from .depth_images import Depth
from .frame_checks import Frames
from .inspect_recording import Inspection, inspect
from .inspection_figure import draw
from .inspection_tables import show
from .lag import Lag
from .noise import Noise

__all__ = ["Depth", "Frames", "Inspection", "Lag", "Noise", "Stream", "draw", "inspect", "show"]
