"""Reinforcement learning in the scenes of ``torchcloth plan``; needs the extra ``rl``.

Importing this package registers ``gymnasium.make("torchcloth/Reach-v0")`` and ``gymnasium.make_vec``, whose scenes are
one batch of the simulator. Both take the arguments of ``make_garment_env``.
"""

from .env import ReachEnv, gymnasium, make_garment_env
from .sac import learn
from .vector_env import ReachVectorEnv

ENVIRONMENT_NAME = "torchcloth/Reach-v0"

__all__ = ["ENVIRONMENT_NAME", "ReachEnv", "ReachVectorEnv", "learn", "make_garment_env"]

if ENVIRONMENT_NAME not in gymnasium.registry:
    gymnasium.register(
        ENVIRONMENT_NAME,
        entry_point=f"{__name__}.env:make_garment_env",
        vector_entry_point=f"{__name__}.vector_env:make_garment_vector_env",
    )
