"""Episodes to look at: in a browser, in rerun's viewer, as GIF and PNG.

film = viewing.film_of(recordings.read("episodes/ep_01"))
viewing.animate(film, "ep_01.gif")
"""

from .distances import film_of_fit, with_cloth
from .episodes import film_of
from .film import Cloud, Curve, Film, Plane, Sheet, Solid, Trace, View
from .pictures import animate, picture

__all__ = [
    "Cloud",
    "Curve",
    "Film",
    "Plane",
    "Sheet",
    "Solid",
    "Trace",
    "View",
    "animate",
    "film_of",
    "film_of_fit",
    "picture",
    "with_cloth",
]
