"""Verification of the physics: what is measured beside its truth, line by line. ``make verify`` runs it."""
