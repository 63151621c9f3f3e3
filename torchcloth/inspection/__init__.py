"""What is in a recording and how far it can be trusted, before anything is fitted to it.

report = inspection.inspect(recordings.read("episodes/ep_01"))
inspection.show(report)
inspection.draw(report, "out/ep_01")
"""

from ..recordings.timing import Stream
from .frames import Frames
from .images import Depth
from .lag import Lag
from .look import Inspection, inspect
from .noise import Noise
from .pictures import draw
from .tables import show

__all__ = ["Depth", "Frames", "Inspection", "Lag", "Noise", "Stream", "draw", "inspect", "show"]
