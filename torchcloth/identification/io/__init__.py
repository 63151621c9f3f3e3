"""Fits on disk: written, checked and loaded again."""
