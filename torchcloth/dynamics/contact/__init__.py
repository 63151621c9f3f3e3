"""Particle-grid transfer: how contact passes between layers of cloth."""

from .grid import (
    APPROACH_PER_COMPRESSION_SPACINGS,
    COMPRESSION_ONSET_SPACINGS,
    FOLD_PATH_RATIO,
    INTERACTION_RANGE_SPACINGS,
    REST_GAP_SPACINGS,
    SEARCH_SKIN_SPACINGS,
    Contact,
    Grid,
)
from .transfer import (
    Stencil,
    affine_momentum,
    place_on_grid,
    stencil_nodes,
    sum_on_nodes,
    transfer_director_forces,
    velocity_gradient,
)

__all__ = [
    "APPROACH_PER_COMPRESSION_SPACINGS",
    "REST_GAP_SPACINGS",
    "INTERACTION_RANGE_SPACINGS",
    "SEARCH_SKIN_SPACINGS",
    "COMPRESSION_ONSET_SPACINGS",
    "FOLD_PATH_RATIO",
    "Contact",
    "Grid",
    "Stencil",
    "affine_momentum",
    "stencil_nodes",
    "transfer_director_forces",
    "place_on_grid",
    "sum_on_nodes",
    "velocity_gradient",
]
