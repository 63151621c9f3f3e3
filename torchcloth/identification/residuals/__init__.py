"""Residuals between simulated and recorded data, and the distances that are reported."""
