"""Contact between layers of cloth: contact points, the grid between them, and the transfer of momentum."""

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
    "COMPRESSION_ONSET_SPACINGS",
    "FOLD_PATH_RATIO",
    "INTERACTION_RANGE_SPACINGS",
    "REST_GAP_SPACINGS",
    "SEARCH_SKIN_SPACINGS",
    "Contact",
    "Grid",
    "Stencil",
    "affine_momentum",
    "place_on_grid",
    "stencil_nodes",
    "sum_on_nodes",
    "transfer_director_forces",
    "velocity_gradient",
]
