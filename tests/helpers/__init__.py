"""Helpers that several test folders share. pytest finds them by ``pythonpath`` in pyproject.toml."""
