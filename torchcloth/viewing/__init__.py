"""Episodes to look at: in a browser, in rerun's viewer, as GIF and PNG.

film = viewing.film_of(recordings.read("episodes/ep_01"))
viewing.animate(film, "ep_01.gif")
"""

from .distances import film_of_fit, with_cloth
from .episodes import film_of
from .film import Cloud, Curve, Film, Plane, Sheet, Solid, Trace, View
from .pictures import RATE, animate, picture
from .plans import film_of_plan
from .poses import film_of_pose
from .rerun_file import write_rrd
from .viser_view import Viewer, write_viser

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
