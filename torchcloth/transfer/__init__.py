"""Particle-grid transfer: how contact passes between layers of cloth."""

from .contact import Contact
from .reference import exchange

__all__ = ["Contact", "exchange"]
