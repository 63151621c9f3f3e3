"""What tests of several rooms share; pytest finds it by ``pythonpath`` in pyproject.toml."""
