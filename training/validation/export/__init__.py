"""Exported cloths, simulated by the engines that they were exported to."""
