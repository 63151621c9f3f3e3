"""Contact between layers of cloth: contact points, the grid between them, and the transfer of momentum."""

from .compression import COMPRESSION_PER_SPACING, closing_rates, compression_at, layer_pressure
from .grid import (
    FOLD_PATH_RATIO,
    INTERACTION_RANGE_SPACINGS,
    REST_GAP_SPACINGS,
    SEARCH_SKIN_SPACINGS,
    Contact,
    Grid,
    grid_shifts,
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
    "COMPRESSION_PER_SPACING",
    "FOLD_PATH_RATIO",
    "INTERACTION_RANGE_SPACINGS",
    "REST_GAP_SPACINGS",
    "SEARCH_SKIN_SPACINGS",
    "Contact",
    "Grid",
    "Stencil",
    "affine_momentum",
    "closing_rates",
    "compression_at",
    "grid_shifts",
    "layer_pressure",
    "place_on_grid",
    "stencil_nodes",
    "sum_on_nodes",
    "transfer_director_forces",
    "velocity_gradient",
]
