"""Episodes to look at: in a browser, in rerun's viewer, as GIF and PNG.

film = viewing.film_of(recordings.read("episodes/ep_01"))
viewing.animate(film, "ep_01.gif")
"""

from .film import Cloud, Curve, Film, Plane, Sheet, Solid, Trace, View
from .fit_film import film_of_fit, with_cloth
from .image_files import RATE, animate, picture
from .plan_film import film_of_plan
from .pose_film import film_of_pose
from .recording_film import film_of
from .rerun_export import write_rrd
from .viser_viewer import Viewer, write_viser

__all__ = [
    "RATE",
    "Cloud",
    "Curve",
    "Film",
    "Plane",
    "Sheet",
    "Solid",
    "Trace",
    "View",
    "Viewer",
    "animate",
    "film_of",
    "film_of_fit",
    "film_of_plan",
    "film_of_pose",
    "picture",
    "with_cloth",
    "write_rrd",
    "write_viser",
]
