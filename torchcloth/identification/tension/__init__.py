"""Fits to the force readings of a tension machine."""
