"""Verification of the physics: measurements and their exact values, line by line. ``make verify`` runs it."""
