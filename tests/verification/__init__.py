"""The verification room: every line of physics.md section 4 measured beside its truth. ``make verify`` runs it."""
