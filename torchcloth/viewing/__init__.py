"""Show episodes in a browser, in rerun's viewer, or as GIF and PNG.

film = viewing.film_from_recording(recordings.read("episodes/ep_01"))
viewing.write_gif(film, "ep_01.gif")
"""

from .film import CameraView, ClothSurface, Cloud, Curve, Film, GripperPath, GroundPlane, RigidBody
from .fit_film import add_cloth, film_from_fit
from .image_files import DEFAULT_GIF_RATE_HZ, write_gif, write_png
from .plan_film import film_from_plan
from .pose_film import film_from_pose
from .recording_film import film_from_recording
from .rerun_export import write_rrd
from .viser_viewer import Viewer, write_viser

__all__ = [
    "DEFAULT_GIF_RATE_HZ",
    "CameraView",
    "ClothSurface",
    "Cloud",
    "Curve",
    "Film",
    "GripperPath",
    "GroundPlane",
    "RigidBody",
    "Viewer",
    "add_cloth",
    "film_from_fit",
    "film_from_plan",
    "film_from_pose",
    "film_from_recording",
    "write_gif",
    "write_png",
    "write_rrd",
    "write_viser",
]
