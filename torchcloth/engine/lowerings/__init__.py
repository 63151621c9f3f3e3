"""Lowerings of materials, effects and boundaries. Each module registers its own when it is imported."""

from importlib import import_module
from pkgutil import iter_modules

from .boundaries import lower_boundaries
from .materials import lower_material
from .viscous_stages import lower_viscous_stages

for _module in iter_modules(__path__):
    import_module(f"{__name__}.{_module.name}")

__all__ = ["lower_boundaries", "lower_material", "lower_viscous_stages"]
