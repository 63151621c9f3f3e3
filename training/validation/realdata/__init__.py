"""Adapters that read published measurements of cloth."""
